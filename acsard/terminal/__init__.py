"""What the tools print with: tables, and output that fits a terminal."""
