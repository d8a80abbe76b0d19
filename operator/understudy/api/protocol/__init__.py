"""What the operator, the monitor and the agents exchange: messages, settings, kept state, and the shell script of held containers.

Users never write these.
"""
