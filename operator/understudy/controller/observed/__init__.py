"""What the operator reads of the cluster around a workload, and what follows from it alone. Pure."""
