"""The demo: a robot, three failures, and what the robot saw of each recovery.

``robotview`` and ``timeline`` need nothing but the standard library and how the console draws bars; the end-to-end tests and the benches
use them too.
"""
