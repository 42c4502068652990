"""Shell package with the control loop and the daemon around it. `daemon.py` reads from top to
bottom."""
