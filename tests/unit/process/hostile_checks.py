"""A process that checks trees like the real one, except that the path of a tree says what goes wrong during its check."""

from __future__ import annotations

import os

from understudy.process import tree_checker_program
from understudy.trees.languages import tree_check
from understudy.trees.languages.tree_check import TreeText, Verdict

BUSY, GREEDY, CRASHING = "busy", "greedy", "crashing"


def check(tree: TreeText) -> Verdict:
    while tree.path == BUSY:
        pass
    if tree.path == GREEDY:
        bytearray(2 * tree_checker_program.MOST_BYTES)
    if tree.path == CRASHING:
        os._exit(7)
    return tree_check.check(tree)


if __name__ == "__main__":
    tree_checker_program.check = check  # type: ignore[attr-defined]
    tree_checker_program.MOST_SECONDS = 0.2  # type: ignore[attr-defined]
    tree_checker_program.main()
