"""Access to the Kubernetes API, for objects as plain dictionaries.

Other packages decide what is written.
"""
