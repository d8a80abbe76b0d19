"""The monitor of one workload, as a pipeline: observe, judge, decide, act, report.

Each stage has a room; `loop.py` connects them.
"""
