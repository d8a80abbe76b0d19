"""How verbs write to a terminal: tables, bars, trees, recoveries and wording.

Nothing here reads from a cluster.
"""
