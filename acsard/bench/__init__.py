"""`acsard bench`: measures a daemon from outside, with one clock."""
