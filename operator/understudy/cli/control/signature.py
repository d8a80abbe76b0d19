"""Who leaves a robot alone and why, as it is written into ``spec.pause`` for whoever finds it so."""

from __future__ import annotations

import argparse
import getpass

from understudy.api.kinds.pause_spec import Pause
from understudy.cli.common.errors import CommandError


def add_options(parser: argparse.ArgumentParser, *, reason: str, required: bool = True) -> None:
    """Let a command be told both; ``reason`` is what its help says of the reason."""
    parser.add_argument("--reason", metavar="TEXT", required=required, help=reason)
    parser.add_argument(
        "--owner",
        metavar="WHO",
        default=getpass.getuser(),
        help="who does it, where that isn't whom you are logged in as",
    )


def signed(given: argparse.Namespace, found: str, *, before: str = "", until: str | None = None) -> Pause:
    """The pause that comes of them, cut to what the API takes, with a word ``before`` the reason.

    Raises CommandError where one is empty; ``found`` is how whoever wants to know will find the robot.
    """
    refuse_empty(given, found)
    return Pause(reason=f"{before}{given.reason}"[:256], owner=given.owner[:128], until=until)


def refuse_empty(given: argparse.Namespace, found: str) -> None:
    """Raise CommandError where who or why is empty; ``found`` is how whoever wants to know will find the robot."""
    for option, text in (("--reason", given.reason), ("--owner", given.owner)):
        if not text.strip():
            raise CommandError(f"{option} is empty: whoever finds it {found} will want to know")
