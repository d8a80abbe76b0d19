"""Calculates how many fallbacks a fleet needs and the order of strategies, with explanations.

Pure functions without access to a cluster or a robot.
"""
