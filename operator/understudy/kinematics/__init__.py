"""How a body moves: poses, velocities, odometry, and whether a robot follows its commands.

Plain Python, without ROS.
"""
