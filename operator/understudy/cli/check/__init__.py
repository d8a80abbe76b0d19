"""The verb `check`: validates manifests without a cluster.

It asks the same models and rules as the operator and the monitor.
"""
