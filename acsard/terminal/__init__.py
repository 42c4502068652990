"""Prints the output of the subcommands, and asks the person near the robot questions."""
