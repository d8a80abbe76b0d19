"""``understudy failover NAME``: switches the robot to an understudy, as planned."""

from __future__ import annotations

from understudy.cli.common.errors import reports_errors
from understudy.cli.control.switchover_request import run


@reports_errors("failover")
def main(arguments: list[str]) -> int:
    """Run the command."""
    return run("failover", arguments)
