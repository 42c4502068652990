"""Pure package that simulates the robot: a vehicle and the microcontroller that drives it."""
