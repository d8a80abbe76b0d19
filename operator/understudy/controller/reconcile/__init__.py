"""Brings one object to its desired state: observe, plan, write, report.

`controller.desired` and `controller.pods` compute the desired state.
"""
