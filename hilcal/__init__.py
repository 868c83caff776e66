"""hilcal: hardware-in-the-loop calibration of the elastic and geometric errors of a robot arm."""

__version__ = "0.1.0"
