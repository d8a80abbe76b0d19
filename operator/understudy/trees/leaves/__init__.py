"""The leaves of health trees, one module each, and the registry that lists them.

Composites and verdicts are in `trees.core`.
"""
