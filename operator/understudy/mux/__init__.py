"""The mux: a process next to the robot's drivers that forwards the commands of exactly one instance per workload.

It holds what decides whom it forwards. It does not judge health beyond silence, and knows nothing of Kubernetes: the monitor commits to
the gate object, and orders what it committed.
"""
