"""The operator: pure functions from what is observed to what should be, and the shell that makes it so."""
