"""What the status of the three kinds reports: conditions, numbers and printed columns. Pure."""
