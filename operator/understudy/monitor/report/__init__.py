"""The last stage: status, Events, metrics, diagnostics and recordings. Never on the path of a failover."""
