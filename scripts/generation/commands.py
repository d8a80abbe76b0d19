"""Builds the reference page of the command line from the parsers of the verbs."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from typing import Any, NoReturn
from unittest import mock

from understudy.cli.common.cluster_access import kubectl
from understudy.cli.common.option_rules import EXAMPLES
from understudy.main import VERBS

_INTRODUCTION = """\
# Command line

<!-- Written by scripts/generate from the parsers of the verbs: change those. -->

Run `understudy VERB`, or `kubectl understudy VERB` if [`kubectl-understudy` is on the PATH](../console.md). `-h` of each verb prints
the same text as this page, and `understudy --version` prints the version. A verb exits with 2 if it is given an unknown option."""

_IN_PODS = """\
The containers of Understudy run these verbs. The verbs have no options: the operator configures them through the environment.
They exit with 0 after a termination signal and with 2 if the environment does not name their workload or pod; `prepare` exits with
0 once the profiles are written and with 1 if they cannot be written."""


def page() -> str:
    """Return the whole page as Markdown."""
    where = argparse.ArgumentParser(add_help=False)
    kubectl.add_options(where)
    shared = [_row(where, action) for action in where._actions]
    lines = [_INTRODUCTION, "", "## Which cluster", ""]
    lines += ["Verbs that access a cluster do so through kubectl, and have these options of it:", "", *_table(shared)]
    for verb, parser in parsers().items():
        lines += ["", f"## {verb}", "", f"`{' '.join([parser.prog, *_needed(parser)])}`", ""]
        lines += [_text(parser, parser.description)]
        rows = [_row(parser, action) for action in parser._actions if action.dest != "help"]
        if own := [row for row in rows if row not in shared]:
            lines += ["", *_table(own)]
        if len(own) < len(rows):
            lines += ["", "Also the options of [which cluster](#which-cluster)."]
        words, _, examples = (parser.epilog or "").partition(EXAMPLES)
        lines += ["", _text(parser, words)]
        if examples:
            lines += ["", "```sh", *(line.strip() for line in examples.splitlines()), "```"]
    lines += ["", "## In pods", "", _IN_PODS, ""]
    lines += [f"- `understudy {verb.name}`: {verb.summary}" for verb in VERBS if not verb.has_options]
    return "\n".join(lines) + "\n"


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of each verb that has one, by the verb."""
    return {verb.name: _parser(verb.module) for verb in sorted(VERBS) if verb.has_options}


class _Asked(BaseException):
    """Ends a verb as soon as its parser is complete."""


def _parser(module: str) -> argparse.ArgumentParser:
    found: list[argparse.ArgumentParser] = []

    def parse(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        found.append(self)
        raise _Asked

    with mock.patch.object(argparse.ArgumentParser, "parse_args", parse):
        try:
            importlib.import_module(module).main([])
        except _Asked:
            return found[0]
    raise ValueError(f"{module} parses no options")


def _needed(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield what must follow a verb: its arguments and its required options."""
    for action in parser._actions:
        name = _value(action)
        if not action.option_strings:
            yield {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} ..."}.get(str(action.nargs), name)
        elif action.required:
            yield f"{action.option_strings[-1]} {name}"


def _value(action: argparse.Action) -> str:
    """Return the word that stands for the value of an argument or option."""
    choices = "|".join(action.choices) if isinstance(action.choices, list | tuple) else ""
    return str(action.metavar or choices or action.dest.upper())


def _table(rows: list[str]) -> list[str]:
    return ["| | |", "| --- | --- |", *rows]


def _row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    *names, last = action.option_strings or [""]
    value = _value(action) if action.nargs != 0 else ""
    named = ", ".join(f"`{name}`" for name in [*names, f"{last} {value}".strip()])
    return f"| {_cell(named)} | {_cell(_text(parser, action.help, **vars(action)))} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _text(parser: argparse.ArgumentParser, text: str | None, **values: Any) -> str:
    """Return a text of a parser in one line, with its placeholders filled in and asterisks escaped for Markdown."""
    return " ".join(((text or "") % {**values, "prog": parser.prog}).replace("*", "\\*").split())
