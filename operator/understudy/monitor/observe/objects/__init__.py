"""Reads from the Kubernetes API: the workload, the workloads that it depends on, pools, storms and metrics.

It writes nothing.
"""
