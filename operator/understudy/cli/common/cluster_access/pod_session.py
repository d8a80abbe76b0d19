"""A session with a program in a pod: one line of JSON per request and answer. The program ends with this process."""

from __future__ import annotations

import contextlib
import json
import select
import subprocess
from collections.abc import Iterator
from typing import Any

from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.errors import CommandError
from understudy.kube.decoding import decode

PATIENCE = 30.0
"""Seconds that an answer may take in addition to the expected time."""


class Session:
    """Sends requests to a program in a pod."""

    def __init__(self, pod: str, running: subprocess.Popen[bytes]) -> None:
        self._pod, self._running = pod, running

    def ask(self, what: str, *, takes: float = 0.0, **arguments: Any) -> Any:
        """Send a request and return the answer; ``takes`` is the expected time in seconds. Raises CommandError."""
        source, sink = self._running.stdout, self._running.stdin
        assert source is not None, "it is a pipe"
        assert sink is not None, "it is a pipe"
        with contextlib.suppress(BrokenPipeError):
            sink.write(json.dumps([what, arguments]).encode() + b"\n")
            sink.flush()
        if not select.select([source], [], [], takes + PATIENCE)[0]:
            raise CommandError(f"pod {self._pod} does not answer")
        line = source.readline()
        if not line:
            raise CommandError(f"the program in pod {self._pod} ended: {self._last_words()}")
        try:
            answer = decode(line)
            if "error" not in answer:
                return answer["answer"]
        except (ValueError, LookupError, TypeError) as error:
            raise CommandError(f"pod {self._pod} gave an answer that cannot be read: {line[:60]!r}") from error
        raise CommandError(f"pod {self._pod}: {answer['error']}")

    def _last_words(self) -> str:
        assert self._running.stderr is not None, "it is a pipe"
        lines = self._running.stderr.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "without a message"


@contextlib.contextmanager
def session(kubectl: Kubectl, pod: str, container: str, *program: str) -> Iterator[Session]:
    """Run a program in a container for the duration of the context."""
    command = kubectl.command("exec", "-i", pod, "-c", container, "--", *program)
    # Ctrl-C must reach this process only, which still has to clean up.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    ) as running:
        try:
            yield Session(pod, running)
        finally:
            running.terminate()
            with contextlib.suppress(BrokenPipeError):
                running.communicate()
