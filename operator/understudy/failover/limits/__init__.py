"""The limits on recoveries: pause, cooldown, backoff, storm guard and budget, each a pure module that says whether it is in force.

Their order of precedence is not here but in ``failover/decide.py``; what a process remembers between two looks is in ``monitor/decide``.
"""
