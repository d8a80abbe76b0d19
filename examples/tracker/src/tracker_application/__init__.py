"""The application of the tracker's example: one node decides how to drive, another hands that to the robot."""
