"""Simulates the robot: the vehicle, and the microcontroller that drives it."""
