"""Waits for objects to change, by kubectls that print a line whenever some have."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO

PAUSE = 10.0
"""Seconds between two beginnings of a watch that may be one without the right to it."""


class Watch:
    """One such kubectl, to be begun anew where it has ended, as API servers end every watch after a while."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._running: subprocess.Popen[bytes] | None = None
        self._begun = 0.0

    def begin(self) -> None:
        """Have it run."""
        self._begun = time.monotonic()
        self._running = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )

    def begin_in_time(self) -> None:
        """The same where it has ended, but not sooner than PAUSE after it was begun last."""
        if self._running is None and time.monotonic() >= self._begun + PAUSE:
            self.begin()

    @property
    def output(self) -> IO[bytes] | None:
        """What it prints; None where it has ended."""
        return self._running.stdout if self._running is not None else None

    def told(self) -> bool:
        """Take in what it has printed; False where it has ended instead."""
        assert self.output is not None, "it runs, and it is a pipe"
        if os.read(self.output.fileno(), 65536):
            return True
        self.end()
        return False

    def end(self) -> None:
        """Have it end."""
        if self._running is not None:
            self._running.terminate()
            self._running.wait()
            if self._running.stdout is not None:
                self._running.stdout.close()
            self._running = None


@contextlib.contextmanager
def waiting(first: Watch, *others: Watch) -> Iterator[Callable[[float], bool]]:
    """While the context lasts, waits at most so many seconds for a watch to tell of a change; whether one did.

    Where the first one ends, that counts as a change. The others may be such as whoever asks hasn't the right to.
    """
    watches = [first, *others]

    def wait(within: float) -> bool:
        end = time.monotonic() + within
        while True:
            for one in others:
                one.begin_in_time()
            running = {one.output: one for one in watches if one.output is not None}
            ready = select.select(list(running), [], [], max(0.0, end - time.monotonic()))[0]
            if not ready:
                return False
            for one in (running[output] for output in ready):
                if one.told():
                    return True
                if one is first:
                    time.sleep(within)  # it may end at once again, such as for want of a right
                    first.begin()
                    return True

    for one in watches:
        one.begin()
    try:
        yield wait
    finally:
        for one in watches:
            one.end()
