"""``understudy failover NAME``: an understudy takes over as planned."""

from __future__ import annotations

from understudy.console.switching import run


def main(arguments: list[str]) -> int:
    """Run the command."""
    return run("failover", arguments)
