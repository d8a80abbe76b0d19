"""Recoveries and planned switchovers from their start to their outcome, and their records.

The protocol itself is in `understudy.failover`.
"""
