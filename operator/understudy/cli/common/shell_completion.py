"""Answers completion requests of shells with argcomplete, which is installed with the extra ``completion``.

The shell starts the command with the current line in its environment. Names of objects come from the cluster that the line selects.
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

from understudy.cli.common.errors import CommandError

_ASKED = "_ARGCOMPLETE"
"""Environment variable of a completion request: the index of the word at which the command begins."""

KUBECTL_FILES_TOO = ":0"
KUBECTL_NO_FILES = ":4"
KUBECTL_NO_FILES_AND_NO_SPACE = ":6"
"""The last line that kubectl reads: whether files may complete too, and whether a completed word may continue, as a folder does."""

_PACKAGES = str(Path(__file__).parents[3])
_PROGRAM = "import sys; sys.path.insert(0, sys.argv.pop()); from understudy.main import main; sys.exit(main())"
"""Runs the command. The path is not in the environment, because a credential plugin that kubectl starts may be in Python too."""

Completer = Callable[..., Sequence[str]]


class NotInstalled(CommandError):
    """argcomplete is not installed."""


def is_asked() -> bool:
    """Return whether this process answers a completion request."""
    return _ASKED in os.environ


def argcomplete() -> ModuleType:
    """Import the package. Raises NotInstalled."""
    try:
        import argcomplete as package
    except ImportError as error:
        raise NotInstalled("argcomplete is not installed: pip install argcomplete (the extra `completion`)") from error
    return package


def complete_verb(verbs: Sequence[str], with_value: Sequence[str]) -> str | None:
    """Return the verb of the line, whose parser then answers (:func:`offer`). If it is incomplete, complete it and return None.

    Options in front of the verb are moved behind it, as when the command runs. ``with_value`` are those with a value.
    """
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    program, *words = line.split() or [""]
    count = 0
    while count < len(words) and words[count].startswith("-"):
        count += 2 if words[count] in with_value else 1
    options, rest = words[:count], words[count:]
    complete = line[-1:].isspace()
    if len(rest) > 1 or (rest and complete):
        if options:
            _ask(" ".join([program, rest[0], *options, *rest[1:]]) + (" " if complete else ""))
        os.environ[_ASKED] = "2"
        return rest[0]
    if options:
        _ask(" ".join([program, *(rest or [""])]))
    parser = argparse.ArgumentParser(prog="understudy", add_help=False)
    parser.add_argument("verb", choices=sorted(verbs))
    answer_request(parser)
    return None


def _ask(line: str) -> None:
    """Have argcomplete complete this line."""
    os.environ |= {"COMP_LINE": line, "COMP_POINT": str(len(line))}


def offer(parser: argparse.ArgumentParser, completers: Mapping[str, Completer]) -> None:
    """Answer a completion request, if there is one, with a complete parser, and exit.

    ``completers`` complete the values of arguments and options, by their metavar.
    """
    if not is_asked():
        return
    for action in parser._actions:
        if (found := completers.get(str(action.metavar or action.dest.upper()))) is not None:
            action.completer = found  # type: ignore[attr-defined]
    answer_request(parser)


def complete_arguments(main: Callable[[list[str]], int]) -> None:
    """Answer with the parser of a verb, and exit.

    A verb that uses a cluster completes names itself (:func:`offer`). The parser of any other verb is complete when it
    parses. Other values complete as files.
    """

    def parse(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        answer_request(self)
        sys.exit(1)

    argparse.ArgumentParser.parse_args = parse  # type: ignore[method-assign]
    main([])


def answer_request(parser: argparse.ArgumentParser) -> None:
    """Print the completions of the request, and exit."""
    try:
        argcomplete().autocomplete(parser, always_complete_options="long")
    except NotInstalled:
        sys.exit(1)


def complete_for_kubectl() -> int:
    """Run ``kubectl_complete-understudy``: kubectl starts it with the words of the line and reads the completions."""
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
        subprocess.run([sys.executable, "-c", _PROGRAM, _PACKAGES], env={**os.environ, **asked}, check=False)
        found = answer.read_text().split("\n") if answer.exists() else []
    candidates = [line.strip() for line in found if line.strip()]
    goes_on = any(word.endswith("/") for word in candidates)
    last = KUBECTL_NO_FILES_AND_NO_SPACE if goes_on else KUBECTL_NO_FILES if candidates else KUBECTL_FILES_TOO
    print("\n".join([*candidates, last]))
    return 0
