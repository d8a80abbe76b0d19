"""Options that say something only beside others are refused elsewhere: whoever gives one expects something of it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable


def only(parser: argparse.ArgumentParser, given: argparse.Namespace, holds: bool, option: str, why: str) -> None:
    """Refuse an option that was given where it says nothing, as argparse refuses others: exit status 2, with the usage before it.

    ``option`` is as people write it, such as ``--to``. Its default must be None, since a default can't be told from the same value given.
    """
    (action,) = (one for one in parser._actions if option in one.option_strings)
    assert action.default is None, option
    if not holds and getattr(given, action.dest) is not None:
        parser.error(f"{'/'.join(action.option_strings)} {why}")


def listed(words: Iterable[str]) -> str:
    """Words as a sentence lists them, such as a, b and c."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last
