"""The sidecar of an instance: starts held containers, and judges, prepares and restores the instance from inside its
pod.

It follows the monitor's commands and decides no failover.
"""
