"""Runs the planner: ``python -m manipulation_stack``."""

from __future__ import annotations

from navigation_stack import managed

from manipulation_stack.mover import started

if __name__ == "__main__":
    managed.run(started, threads=4)
