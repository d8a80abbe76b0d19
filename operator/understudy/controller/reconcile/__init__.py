"""Brings one object to its desired state: observe, plan, write, report.

What should exist is computed in `controller.desired` and `controller.pods`.
"""
