"""Trees as BehaviorTree.CPP 4 writes them, turned into the short form.

What a tree means is defined in `trees.languages.short`.
"""
