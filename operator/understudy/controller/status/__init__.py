"""The status of the three kinds: conditions, numbers and printed columns. Pure."""
