"""Shell: `acsard bench`: a daemon measured from outside, on one clock."""
