"""`acsard web`: a process that serves the robot's web page, and is a client of the bus."""
