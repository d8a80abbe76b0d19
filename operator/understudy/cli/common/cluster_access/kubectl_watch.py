"""Waits for changes of objects with ``kubectl get --watch`` processes."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO

PAUSE = 10.0
"""Least seconds between two starts of an optional watch, which may fail at once for lack of permission."""


class Watch:
    """One ``kubectl get --watch`` process. The API server ends every watch after a while, so it must be restartable."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._running: subprocess.Popen[bytes] | None = None
        self._started = 0.0

    def begin(self) -> None:
        """Start the process."""
        self._started = time.monotonic()
        self._running = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )

    def restart_if_due(self) -> None:
        """Start the process again if it ended, at the earliest PAUSE after its last start."""
        if self._running is None and time.monotonic() >= self._started + PAUSE:
            self.begin()

    @property
    def output(self) -> IO[bytes] | None:
        """Its output; None if it ended."""
        return self._running.stdout if self._running is not None else None

    def read(self) -> bool:
        """Read the pending output; return False if the process ended instead."""
        assert self.output is not None, "it runs, and it is a pipe"
        if os.read(self.output.fileno(), 65536):
            return True
        self.end()
        return False

    def end(self) -> None:
        """Stop the process."""
        if self._running is not None:
            self._running.terminate()
            self._running.wait()
            if self._running.stdout is not None:
                self._running.stdout.close()
            self._running = None


@contextlib.contextmanager
def waiting(first: Watch, *others: Watch) -> Iterator[Callable[[float], bool]]:
    """Yield a function that waits up to the given seconds and returns whether a watch reported a change.

    The end of the first watch counts as a change. The others are optional: the user may lack the permission.
    """
    watches = [first, *others]

    def wait(within: float) -> bool:
        end = time.monotonic() + within
        while True:
            for one in others:
                one.restart_if_due()
            running = {one.output: one for one in watches if one.output is not None}
            ready = select.select(list(running), [], [], max(0.0, end - time.monotonic()))[0]
            if not ready:
                return False
            for one in (running[output] for output in ready):
                if one.read():
                    return True
                if one is first:
                    time.sleep(within)  # the watch may end at once again
                    first.begin()
                    return True

    for one in watches:
        one.begin()
    try:
        yield wait
    finally:
        for one in watches:
            one.end()
