"""Prompts for the person beside the robot: at a terminal, or through a program."""
