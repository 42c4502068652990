"""Shell: the control loop and the daemon around it; `daemon.py` reads top to bottom."""
