"""The robot of the navigation example: a differential drive base with a laser scanner in MuJoCo, as a ROS 2 node."""

import time

STARTED = time.monotonic()
"""When the process began to import us, so that the nodes can say how long their own start took, imports included."""
