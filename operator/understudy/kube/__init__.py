"""Everything that touches the Kubernetes API, for objects as plain dictionaries.

What should be written is decided elsewhere.
"""
