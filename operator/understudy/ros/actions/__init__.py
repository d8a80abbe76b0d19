"""Acts on a ROS graph: calls, goals, publications and streams of snapshots.

Code that only observes is in `ros.observe`.
"""
