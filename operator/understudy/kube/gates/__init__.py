"""Gates, which decide which instance's outputs reach a robot, and the policy that isolates unclaimed pods.

base.py defines what a gate is, and kinds/ has one module for each kind. The failover protocol, the monitor, the operator and the commands
use the registry and know no specific kind.
"""
