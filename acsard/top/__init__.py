"""Shell: `acsard top`: what a running robot says, on one screen."""
