"""Simulates the robot: the vehicle, and the microcontroller that controls its motors."""
