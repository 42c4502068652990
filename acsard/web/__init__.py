"""`acsard web`: a process that serves the robot's web page. It is a client of the Zenoh bus."""
