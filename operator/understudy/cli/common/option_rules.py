"""What options of several verbs share: the output format, refusing an option that has no effect beside the others, and parsing values."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Iterable
from typing import TypeVar

from understudy.api.base import seconds

Number = TypeVar("Number", int, float)


def reject_unless(
    parser: argparse.ArgumentParser, options: argparse.Namespace, holds: bool, option: str, why: str
) -> None:
    """Refuse an option that has no effect here: print the usage and exit with status 2, as argparse does.

    ``option`` is written as on the command line, such as ``--to``. Its default must be None, to tell a given value from the default.
    """
    (action,) = (one for one in parser._actions if option in one.option_strings)
    assert action.default is None, option
    if not holds and getattr(options, action.dest) is not None:
        parser.error(f"{'/'.join(action.option_strings)} {why}")


EXAMPLES = "\n\nExamples:\n"
"""Between the epilog of a parser and its examples (:func:`add_examples`)."""


def add_examples(parser: argparse.ArgumentParser, *commands: str) -> None:
    """Show examples at the end of the help, each on a line of its own."""
    parser.formatter_class = _WithExamples
    parser.epilog = f"{parser.epilog}{EXAMPLES}" + "\n".join(f"  {command}" for command in commands)


class _WithExamples(argparse.HelpFormatter):
    """Wraps texts, but not examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        words, mark, examples = text.partition(EXAMPLES)
        return f"{super()._fill_text(words, width, indent)}{mark}{examples}"


def add_output(parser: argparse._ActionsContainer, words: str = "text, or all details as JSON or YAML") -> None:
    """Add ``--output`` with the formats text, JSON and YAML."""
    parser.add_argument("-o", "--output", choices=["text", "json", "yaml"], default="text", help=words)


def whole(least: int, most: float = math.inf, more: str = "") -> Callable[[str], int]:
    """Return a parser for ``type=`` of an option that takes a whole number within bounds; ``more`` is added to its error."""
    return _within(int, "a whole number", least, most, more)


def number(least: float, most: float) -> Callable[[str], float]:
    """Return a parser for ``type=`` of an option that takes a number within bounds."""
    return _within(float, "a number", least, most)


def _within(
    read: Callable[[str], Number], what: str, least: float, most: float, more: str = ""
) -> Callable[[str], Number]:
    bounds = f"of at least {least:g}" if most == math.inf else f"from {least:g} to {most:.10g}"

    def parse(text: str) -> Number:
        with contextlib.suppress(ValueError):
            if least <= (found := read(text)) <= most:
                return found
        raise argparse.ArgumentTypeError(f"found {text!r:.50}; give {what} {bounds}{more}")

    return parse


def duration(text: str) -> float:
    """Parse a duration above 0 into seconds: as in manifests, such as ``1m30s``, or a number of seconds. For ``type=`` of an option."""
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
    """Join words into a list for a sentence, such as "a, b and c"."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last
