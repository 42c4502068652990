"""Prints the output of the subcommands, and asks questions of the person near the robot."""
