"""The third stage: decides what should happen now, if anything. It changes nothing outside the process."""
