"""The action proxy: clients talk to it, and their goals outlive the instance that works on them.

Which instance is in control, the monitor reports to it.
"""
