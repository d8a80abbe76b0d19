"""The last stage: reports in the status, Events, metrics, diagnostics and recordings. Never on the path of a failover."""
