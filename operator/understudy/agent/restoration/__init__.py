"""Restores kept state and goals to the agent's instance, and runs procedures on it.

The monitor decides when that happens.
"""
