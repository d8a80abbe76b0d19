"""Who may drive: the first opening of the gate, permits and the reflex.

The commits themselves are in `objects`, and what happens to pods is in `instances`.
"""
