"""The package of `acsard bench`, which measures a daemon from outside, on a single clock."""
