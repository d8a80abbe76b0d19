"""What a fleet's recoveries came to in a period: one page to keep, and the data."""
