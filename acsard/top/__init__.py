"""`acsard top` shows the state of a running robot on one terminal screen."""
