"""``understudy completion bash | zsh | fish``: what a shell has to run so that Tab completes verbs, options and names."""

from __future__ import annotations

import argparse
import sys

from understudy.cli.common import shell_completion
from understudy.cli.common.shell_completion import NotInstalled

DONE, CANT = 0, 2
"""Exit statuses."""

_COMMANDS = ("understudy", "kubectl-understudy")


def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    shell_completion.offer(parser, {})
    given = parser.parse_args(arguments)
    try:
        print(shell_completion.argcomplete().shellcode(_COMMANDS, shell=given.shell))
    except NotInstalled as error:
        print(f"understudy completion: {error}", file=sys.stderr)
        return CANT
    return DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy completion",
        description="Prints what a shell has to run so that Tab completes the verbs of this command, their options, and the names of the "
        'cluster: eval "$(understudy completion bash)" in ~/.bashrc, the same with zsh in ~/.zshrc, and '
        "understudy completion fish | source in ~/.config/fish/config.fish. kubectl understudy needs nothing but kubectl's own completion.",
        epilog="Exit status: 0 where it is printed, 2 where argcomplete isn't installed.",
    )
    parser.add_argument("shell", choices=["bash", "zsh", "fish"], help="the shell")
    return parser
