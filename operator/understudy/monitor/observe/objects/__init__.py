"""What the monitor reads from the Kubernetes API: its workload, the workloads that it depends on, pools, storms and metrics.

It writes nothing.
"""
