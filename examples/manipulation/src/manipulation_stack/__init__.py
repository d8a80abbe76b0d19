"""The stack of the manipulation example: plans motions of the arm round what is in the way, and streams its joint commands."""
