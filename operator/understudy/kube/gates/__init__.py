"""Gates: what decides which instance's outputs reach a robot, and the policy of unclaimed pods, which may not reach it.

base.py says what a gate is, and kinds/ has one module for each kind. The failover protocol, the monitor, the operator and the command
ask through the registry and know no kind.
"""
