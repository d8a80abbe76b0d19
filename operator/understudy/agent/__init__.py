"""The sidecar of an instance: starts what is held, and judges, prepares and restores the instance from inside its pod.

It follows the monitor's commands and decides no failover.
"""
