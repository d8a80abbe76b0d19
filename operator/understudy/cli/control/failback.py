"""``understudy failback NAME``: switches the robot back to a pod of the workload's own controller."""

from __future__ import annotations

from understudy.cli.common.errors import reports_errors
from understudy.cli.control.switchover_request import run


@reports_errors("failback")
def main(arguments: list[str]) -> int:
    """Run the command."""
    return run("failback", arguments)
