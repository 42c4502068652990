"""`acsard foxglove`: a process that shows the robot live in the viewers Foxglove and Lichtblick."""
