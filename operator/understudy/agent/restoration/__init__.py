"""How an agent brings kept state and goals to its instance, with procedures and poses.

When it does so the monitor decides.
"""
