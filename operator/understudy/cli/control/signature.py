"""The options ``--reason`` and ``--owner``, which are recorded in the workload."""

from __future__ import annotations

import argparse
import getpass

from understudy.api.kinds.pause_spec import Pause
from understudy.cli.common.errors import CommandError


def add_options(parser: argparse.ArgumentParser, *, reason: str, required: bool = True) -> None:
    """Add both options; ``reason`` is the help text of the reason."""
    parser.add_argument("--reason", metavar="TEXT", required=required, help=reason)
    parser.add_argument(
        "--owner",
        metavar="WHO",
        default=getpass.getuser(),
        help="name of the person who does it (default: the user name on this machine)",
    )


def signed(options: argparse.Namespace, found: str, *, before: str = "", until: str | None = None) -> Pause:
    """Build a pause with them, cut to the lengths that the API accepts, with a prefix ``before`` the reason.

    Raises CommandError if one is empty; ``found`` is the state in which others find the robot.
    """
    refuse_empty(options, found)
    return Pause(reason=f"{before}{options.reason}"[:256], owner=options.owner[:128], until=until)


def refuse_empty(options: argparse.Namespace, found: str) -> None:
    """Raise CommandError if reason or owner is empty; ``found`` is the state in which others find the robot."""
    for option, text in (("--reason", options.reason), ("--owner", options.owner)):
        if not text.strip():
            raise CommandError(f"{option} is empty: others who find the robot {found} need to know it")
