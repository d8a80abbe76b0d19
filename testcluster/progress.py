"""Prints progress for people on standard error: the current step, and its duration."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Progress:
    """Prints lines that start with the seconds since this object was made."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def __call__(self, text: str) -> None:
        """Print one line."""
        print(f"[{time.monotonic() - self._start:6.1f} s] {text}", file=sys.stderr, flush=True)

    @contextmanager
    def step(self, text: str) -> Iterator[None]:
        """Print the step when it begins and, if it took longer than a second, when it is done."""
        self(text)
        start = time.monotonic()
        yield
        took = time.monotonic() - start
        if took > 1:
            self(f"{text}: done in {took:.1f} s")


def wait_until(
    condition: Callable[[], bool],
    seconds: float,
    what: str,
    interval: float = 0.1,
    despite: type[Exception] | tuple[type[Exception], ...] = (),
) -> None:
    """Wait until the condition holds.

    Args:
        despite: errors of the condition that only mean that it does not hold yet.

    Raises:
        TimeoutError: it did not hold within the given seconds; the message has ``what`` and the last of those errors.
    """
    deadline = time.monotonic() + seconds
    while True:
        said = ""
        try:
            if condition():
                return
        except despite as error:
            said = f"; the last error: {error}"
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not so within {seconds:g} s{said}")
        time.sleep(interval)
