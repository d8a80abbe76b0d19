"""Verbs that advise before anything is deployed: `size` and `recommend`. They need no cluster and no ROS."""
