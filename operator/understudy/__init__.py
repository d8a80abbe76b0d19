"""Understudy keeps ROS 2 robots working when the software that drives them fails."""

__version__ = "0.2.0"
