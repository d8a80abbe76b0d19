"""The operator's process: watches, store, queue, workers, metrics. It knows when an object is reconciled, not how."""
