"""The operator: pure functions from what is observed to what should exist, and the shell that applies the result."""
