"""The objects that a workload should have, computed from what is observed.

Pure: the writes are made in `controller.reconcile`.
"""
