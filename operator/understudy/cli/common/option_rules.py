"""What options have in common: those that say something only beside others are refused elsewhere, since whoever gives one expects something
of it; and durations are read alike.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterable

from understudy.api.base import seconds


def only(parser: argparse.ArgumentParser, given: argparse.Namespace, holds: bool, option: str, why: str) -> None:
    """Refuse an option that was given where it says nothing, as argparse refuses others: exit status 2, with the usage before it.

    ``option`` is as people write it, such as ``--to``. Its default must be None, since a default can't be told from the same value given.
    """
    (action,) = (one for one in parser._actions if option in one.option_strings)
    assert action.default is None, option
    if not holds and getattr(given, action.dest) is not None:
        parser.error(f"{'/'.join(action.option_strings)} {why}")


def duration(text: str) -> float:
    """The ``type`` of an option that takes a length of time above 0: a duration as manifests have them, such as ``1m30s``, or a number
    of seconds. Comes to seconds.
    """
    found = math.nan
    for read in (seconds, float):
        with contextlib.suppress(ValueError):
            found = read(text)
            break
    if not (math.isfinite(found) and found > 0):
        raise argparse.ArgumentTypeError(
            f"found {text!r:.50}; give a duration above 0, such as 500ms, 6s or 1m30s (a number alone is seconds)"
        )
    return found


def listed(words: Iterable[str]) -> str:
    """Words as a sentence lists them, such as a, b and c."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last
