"""The state of the cluster around a workload as the operator reads it, and what follows from it alone. Pure."""
