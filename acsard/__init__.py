"""acsard: the hardware interface daemon of a four-wheel differential-drive robot."""

__version__ = "0.1.0"
