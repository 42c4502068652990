"""The robot's web page: `acsard web` is a process of its own and a client of the bus."""
