"""The limits on recoveries: pause, cooldown, backoff, storm guard and budget, each a pure module that reports whether it is in force.

Their order of precedence is in ``failover/decide.py``. What a process remembers between two checks is in ``monitor/decide``.
"""
