"""Has a person confirm what can't be taken back, or what a robot would notice."""

from __future__ import annotations

import argparse
import sys

from understudy.cli.common.errors import CommandError


def add_option(parser: argparse.ArgumentParser) -> None:
    """Let a command be told that it is meant."""
    parser.add_argument("-y", "--yes", action="store_true", help="don't ask whether it is meant")


def confirm(question: str, *, yes: bool) -> None:
    """Ask in a terminal. Raises CommandError where the answer is no, or where nobody can be asked."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise CommandError(f"{question} There is no terminal to ask in: say that it is meant with --yes")
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise CommandError("nothing was done")
