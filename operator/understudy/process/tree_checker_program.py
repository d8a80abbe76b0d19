"""The process that checks trees for another one: reads requests from standard input, and writes verdicts to standard output.

The kernel ends it if a check takes too much processor time, whatever the check is doing.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from dataclasses import asdict
from typing import BinaryIO

from understudy.process.tree_checker import LENGTH, MOST_BYTES, MOST_SECONDS
from understudy.trees.languages.tree_check import TreeText, check, too_costly

NICENESS = 10
"""The priority of this process. Whoever waits for a verdict has more urgent things to do meanwhile."""


def main() -> None:
    """Answer requests until the other process closes the input."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    sys.stdout = sys.stderr  # what libraries print is no answer
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, resource.RLIM_INFINITY))
    while (request := _read(requests)) is not None:
        tree = TreeText(**json.loads(request))
        _limit_processor_time()
        try:
            verdict = check(tree)
        except MemoryError:
            why = f"its check takes more than {MOST_BYTES >> 20} MiB of memory"
            verdict = too_costly(tree, why, MOST_SECONDS)
        answer = json.dumps(asdict(verdict)).encode()
        answers.write(LENGTH.pack(len(answer)) + answer)
        answers.flush()


def _read(requests: BinaryIO) -> bytes | None:
    head = requests.read(LENGTH.size)
    return requests.read(LENGTH.unpack(head)[0]) if len(head) == LENGTH.size else None


def _limit_processor_time() -> None:
    """Let the kernel end this process if it takes MOST_SECONDS from now on. The limit has whole seconds, so round up."""
    until = int(time.process_time() + MOST_SECONDS) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (until, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main()
