"""How verbs reach a cluster: kubectl, its proxy and watches, and sessions in pods.

What they print is in `text`.
"""
