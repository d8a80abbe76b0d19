"""``understudy failover NAME``: switches the robot to an understudy, as planned."""

from __future__ import annotations

from understudy.cli.control.switchover_request import run


def main(arguments: list[str]) -> int:
    """Run the command."""
    return run("failover", arguments)
