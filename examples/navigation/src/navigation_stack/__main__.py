"""Starts the whole stack: ``python -m navigation_stack``. Each node is a process of its own.

A signal to end is passed on to all of them. As with ``ros2 launch``, the others live on when one of them ends; when the
last one has ended this does too, and when this one is killed they are.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from types import FrameType

from navigation_stack.names import NODES

GRACE = 3.0
"""s that nodes have to end."""

_PR_SET_PDEATHSIG = 1


class Stack:
    """The nodes' processes."""

    def __init__(self) -> None:
        nodes = [*NODES, *(["lifecycle_manager"] if os.environ.get("NAVIGATION_AUTOSTART") == "1" else [])]
        libc = ctypes.CDLL(None)
        self._children = {
            node: subprocess.Popen(
                [sys.executable, "-m", f"navigation_stack.{node}"],
                preexec_fn=lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL),
            )
            for node in nodes
        }
        self._told_at: float | None = None

    def end(self, number: int, frame: FrameType | None) -> None:
        """Pass a signal on."""
        self._told_at = self._told_at or time.monotonic()
        for child in self._children.values():
            if child.poll() is None:
                child.send_signal(number)

    def run(self) -> int:
        """Wait for all of them; 0 if they were asked to end."""
        while self._children:
            for node, child in list(self._children.items()):
                if child.poll() is not None:
                    del self._children[node]
                    if self._told_at is None:
                        print(
                            f"navigation_stack: {node} has ended with {child.returncode}", file=sys.stderr, flush=True
                        )
            if self._told_at is not None and time.monotonic() - self._told_at > GRACE:
                for child in self._children.values():
                    child.kill()
            time.sleep(0.1 if self._told_at is None else 0.02)
        return 0 if self._told_at is not None else 1


def main() -> int:
    """Run the stack."""
    stack = Stack()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stack.end)
    return stack.run()


if __name__ == "__main__":
    sys.exit(main())
