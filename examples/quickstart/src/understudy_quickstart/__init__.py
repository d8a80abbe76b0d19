"""A small ROS 2 robot and the application that drives it: what Understudy's demo and end-to-end tests protect."""

import time

STARTED = time.monotonic()
"""When the process began to import us, so that the nodes can say how long their own start took, imports included."""
