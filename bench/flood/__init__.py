"""Failovers in the middle of floods, which a stranger's pod sends to everything that protects a robot.

``flooder`` is the program that runs in that pod, and imports nothing of the project. ``stranger`` starts it, ``targets`` says what it
floods, ``series`` makes failures and reads what happened to the robot, ``report`` makes figures.
"""
