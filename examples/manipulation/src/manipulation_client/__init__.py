"""The client of the manipulation example: has an arm take one pose after the other."""
