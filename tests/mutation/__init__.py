"""The mutation check of the safety core; `__main__.py` tells how to run it."""
