"""Decides which instance may drive: the first opening of the gate, permits and the reflex.

`objects` contains the writes of the gate, and `instances` handles the pods.
"""
