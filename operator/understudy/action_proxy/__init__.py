"""The action proxy: clients talk to it, and their goals outlive the instance that works on them.

The monitor reports the active instance to it.
"""
