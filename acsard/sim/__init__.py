"""The simulated robot, pure: a vehicle and the microcontroller that runs it."""
