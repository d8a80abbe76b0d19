"""The operator's process: watches, queue, workers, metrics. It decides when an object is reconciled.

`controller.reconcile` contains how.
"""
