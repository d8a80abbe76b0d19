"""What acts on a ROS graph: calls, goals, publications and streams of snapshots.

What only watches is in `ros.observe`.
"""
