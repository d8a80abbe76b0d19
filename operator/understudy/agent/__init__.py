"""The sidecar of an instance: starts held containers, and judges, prepares and restores the instance.

It works from inside the instance's pod, follows the monitor's commands, and decides no failover.
"""
