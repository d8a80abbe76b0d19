"""The running tree: observations, evidence, verdicts and exact deadlines.

How a tree is written is in `trees.source` and `trees.languages`.
"""
