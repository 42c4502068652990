"""The robot's page: `acsard web`, a process of its own and a client of the bus."""
