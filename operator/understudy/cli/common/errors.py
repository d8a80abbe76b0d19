"""Errors that end a verb with a message and exit status 2."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable

from understudy.api.plain_text import plain

ERROR = 2
"""Exit status of a verb that cannot be carried out. argparse exits with it, too."""

Main = Callable[[list[str]], int]


class CommandError(Exception):
    """The command cannot be carried out. The message says what was found and what to do."""


class Forbidden(CommandError):
    """The user does not have the permission."""


def reports_errors(verb: str) -> Callable[[Main], Main]:
    """Let the ``main`` of a verb print the message of a CommandError, and return ERROR."""

    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def reporting(arguments: list[str]) -> int:
            try:
                return main(arguments)
            except CommandError as error:
                # Further lines are indented, so that a line of others does not look like one of ours.
                lines = "\n  ".join(map(plain, str(error).split("\n")))
                print(f"understudy {verb}: {lines}", file=sys.stderr)
                return ERROR

        return reporting

    return decorate
