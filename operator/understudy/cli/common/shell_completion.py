"""Answers a shell that asks what may come next on the command line, by argcomplete, which is installed with the extra ``completion``.

The shell starts the command with the line so far in its environment. What may be named comes from the cluster that the line says.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

_ASKED = "_ARGCOMPLETE"
"""In the environment when a shell asks: the place of the word at which the command begins."""

KUBECTL_FILES_TOO = ":0"
KUBECTL_NO_FILES = ":4"
KUBECTL_NO_FILES_AND_NO_SPACE = ":6"
"""What kubectl wants to read last: whether files may be meant as well, and whether what is completed may go on, as a folder does."""

Completer = Callable[..., Sequence[str]]


class NotInstalled(Exception):
    """argcomplete isn't there."""


def is_asked() -> bool:
    """Whether this process was started to answer a shell."""
    return _ASKED in os.environ


def argcomplete() -> ModuleType:
    """The package. Raises NotInstalled."""
    try:
        import argcomplete as package
    except ImportError as error:
        raise NotInstalled("what completes is missing: pip install argcomplete (the extra `completion`)") from error
    return package


def complete_verb(verbs: Sequence[str]) -> str | None:
    """The verb of the line, whose parser then answers (:func:`offer`); None where the verb itself was asked for, which is answered."""
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    words = line.split()
    if len(words) > 2 or (len(words) == 2 and line[-1:].isspace()):
        os.environ[_ASKED] = "2"
        return words[1]
    parser = argparse.ArgumentParser(prog="understudy", add_help=False)
    parser.add_argument("verb", choices=sorted(verbs))
    _answer(parser)
    return None


def offer(parser: argparse.ArgumentParser, completers: Mapping[str, Completer]) -> None:
    """Answer by a parser that is whole, where a shell asks, which ends this process; ``completers`` are for arguments and
    options, by the word that stands for their value.
    """
    if not is_asked():
        return
    for action in parser._actions:
        if (found := completers.get(str(action.metavar or action.dest.upper()))) is not None:
            action.completer = found  # type: ignore[attr-defined]
    _answer(parser)


def complete_arguments(main: Callable[[list[str]], int]) -> None:
    """Answer by the parser of a verb, which ends this process. One that asks a cluster offers the names in it (:func:`offer`); of any
    other the parser is whole, at the latest, when it is asked to parse. Values for which there is no other word are files.
    """

    def parse(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        _answer(self)
        sys.exit(1)

    argparse.ArgumentParser.parse_args = parse  # type: ignore[method-assign]
    main([])


def _answer(parser: argparse.ArgumentParser) -> None:
    try:
        argcomplete().autocomplete(parser, always_complete_options="long")
    except NotInstalled:
        sys.exit(1)


def complete_for_kubectl() -> int:
    """``kubectl_complete-understudy``: kubectl asks a program of this name, gives it the words, and reads lines."""
    words = sys.argv[1:]
    line = " ".join(["understudy", *words])
    with tempfile.TemporaryDirectory(prefix="understudy-") as folder:
        answer = Path(folder, "answer")
        asked: dict[str, Any] = {
            _ASKED: "1",
            "_ARGCOMPLETE_IFS": "\n",
            "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
            "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
            "COMP_LINE": line,
            "COMP_POINT": str(len(line)),
        }
        subprocess.run([sys.executable, "-m", "understudy"], env={**os.environ, **asked}, check=False)
        found = answer.read_text().split("\n") if answer.exists() else []
    said = [line.strip() for line in found if line.strip()]
    goes_on = any(word.endswith("/") for word in said)
    last = KUBECTL_NO_FILES_AND_NO_SPACE if goes_on else KUBECTL_NO_FILES if said else KUBECTL_FILES_TOO
    print("\n".join([*said, last]))
    return 0
