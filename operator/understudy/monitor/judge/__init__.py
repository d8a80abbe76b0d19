"""The second stage: whether the workload is healthy, degraded or failed, and since when. It decides nothing."""
