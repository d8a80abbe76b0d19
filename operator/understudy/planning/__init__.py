"""Commands that answer what to ask for, before it is asked for: ``understudy size``, ``recommend``. They need no cluster and no ROS."""
