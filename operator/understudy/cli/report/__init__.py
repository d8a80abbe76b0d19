"""The verb `report`: the recoveries of a fleet in a period, as one page to keep and as data."""
