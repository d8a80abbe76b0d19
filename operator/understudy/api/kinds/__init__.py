"""The pydantic models of RobotWorkload, FailurePolicy and FallbackPool, one module per kind or per part of a spec.

What the parts of Understudy say to each other is in `api.protocol`.
"""
