"""`acsard foxglove`: the robot live in Foxglove and Lichtblick, a process of its own."""
