"""The gate, and who may drive: commits, the first opening, permits and the reflex.

What happens to pods is in `instances`.
"""
