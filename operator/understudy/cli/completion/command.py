"""``understudy completion bash | zsh | fish``: prints the completion script of a shell."""

from __future__ import annotations

import argparse

from understudy.cli.common import shell_completion
from understudy.cli.common.errors import reports_errors
from understudy.cli.common.option_rules import add_examples

_COMMANDS = ("understudy", "kubectl-understudy")


@reports_errors("completion")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    shell_completion.offer(parser, {})
    options = parser.parse_args(arguments)
    print(shell_completion.argcomplete().shellcode(_COMMANDS, shell=options.shell))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy completion",
        description="Prints the completion script of a shell. With it, the shell completes verbs, options, and names of objects in the "
        'cluster. To load it, write into ~/.bashrc: eval "$(understudy completion bash)"; into ~/.zshrc: eval "$(understudy completion '
        "zsh)\"; into ~/.config/fish/config.fish: understudy completion fish | source. For kubectl understudy, kubectl's own completion "
        "is enough.",
        epilog="Exit status: 0 if the script was printed, 2 if argcomplete is not installed.",
    )
    add_examples(parser, 'eval "$(understudy completion bash)"', "understudy completion fish | source")
    parser.add_argument("shell", choices=["bash", "zsh", "fish"], help="the shell")
    return parser
