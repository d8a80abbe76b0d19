"""The state of the cluster around a workload as the operator reads it, and values that follow from it alone. Pure."""
