"""The second stage: judges whether the workload is healthy, degraded or failed, and since when. It decides nothing."""
