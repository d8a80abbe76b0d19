"""The action proxy: an action server for clients, whose goals outlive the instance that works on them.

The monitor reports the active instance to it.
"""
