"""The operator: pure functions from observed state to desired objects, and the shell that applies the result."""
