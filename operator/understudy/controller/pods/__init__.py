"""The pods of workloads and pools: their templates, their numbers, and which of them are deleted. Pure."""
