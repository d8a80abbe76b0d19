"""The pods of workloads and pools: their templates, how many there should be, and which are deleted. Pure."""
