"""The objects that a workload should have, computed from the observed state.

Pure: `controller.reconcile` makes the writes.
"""
