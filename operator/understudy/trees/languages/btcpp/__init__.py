"""Reads trees in the XML of BehaviorTree.CPP 4 and converts them into the short form.

The meaning of a tree is defined in `trees.languages.short`.
"""
