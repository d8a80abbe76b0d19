"""Reads manifests and validates single objects without a cluster, by the operator's own models, rules and loaders.

`check`, `simulate` and `recommend` use it. Checks across several objects live in `cli/check`.
"""
