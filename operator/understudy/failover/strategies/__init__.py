"""The mitigation strategies: each puts one understudy in control, and can be repeated from any step.

``failover/availability.py`` decides whether one could run now, and ``failover/protocol.py`` in which order they are tried.
"""
