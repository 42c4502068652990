"""`acsard foxglove` shows the robot live in Foxglove and Lichtblick; it is a process of its own."""
