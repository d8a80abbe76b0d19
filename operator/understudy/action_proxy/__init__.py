"""The action proxy: an action server for clients, whose goals outlive the instance that executes them.

The monitor reports the active instance to the proxy.
"""
