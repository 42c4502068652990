"""How a verb asks who stands beside the robot: at a terminal, or through a program."""
