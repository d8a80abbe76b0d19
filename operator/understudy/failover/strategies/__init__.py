"""The mitigation strategies: each puts one understudy in control, and can be repeated from any step.

Whether one could run now is decided in ``failover/availability.py``, and the order in which they are tried in ``failover/protocol.py``.
"""
