"""The robot of the manipulation example: a six-joint arm in MuJoCo with its controller, as a ROS 2 node."""

import time

STARTED = time.monotonic()
"""When the process began to import us, so that the node can say how long its own start took, imports included."""
