"""What the operator, the monitor and the agents exchange: messages, settings, kept state and the shell that holds a container.

Users never write these.
"""
