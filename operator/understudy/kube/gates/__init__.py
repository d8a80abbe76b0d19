"""The gates, each of which decides whose outputs reach a robot.

The failover protocol does not know which kind is in use.
"""
