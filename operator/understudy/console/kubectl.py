"""What is asked of a cluster goes through kubectl: whoever has access by it has access here, however they prove who they are."""

from __future__ import annotations

import contextlib
import json
import re
import select
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from typing import Any

TIMEOUT = 15.0
"""Seconds that the API server has to answer, and a forwarding to begin."""

_FORWARDING = re.compile(r"Forwarding from 127\.0\.0\.1:(\d+) ")


class Unusable(Exception):
    """What was asked for can't be done; the text says why, and what to do."""


class Kubectl:
    """kubectl with the options that say which cluster and which namespace."""

    def __init__(self, options: Sequence[str]) -> None:
        """Raises Unusable where there is no kubectl."""
        if shutil.which("kubectl") is None:
            raise Unusable("kubectl isn't on the PATH; install it, since the cluster is asked through it")
        self._options = list(options)

    def get(self, kind: str, *arguments: str) -> Any:
        """An object, or a list of them. Raises Unusable with what kubectl said."""
        command = ["kubectl", *self._options, "get", kind, *arguments, "-o", "json", f"--request-timeout={TIMEOUT:g}s"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = done.stderr.strip().splitlines()
            raise Unusable(said[-1] if said else f"kubectl ended with {done.returncode}")
        return json.loads(done.stdout)

    @contextlib.contextmanager
    def forwarded(self, pod: str, port: int) -> Iterator[int]:
        """A port on this machine that leads to one of a pod, while the context lasts. Raises Unusable."""
        command = ["kubectl", *self._options, "port-forward", f"pod/{pod}", f":{port}", "--address=127.0.0.1"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
            try:
                yield _port(running)
            finally:
                running.terminate()


def _port(running: subprocess.Popen[str]) -> int:
    assert running.stdout is not None, "it is a pipe"
    assert running.stderr is not None, "it is a pipe"
    end = time.monotonic() + TIMEOUT
    while (left := end - time.monotonic()) > 0:
        if not select.select([running.stdout], [], [], left)[0]:
            break
        line = running.stdout.readline()
        if found := _FORWARDING.match(line):
            return int(found[1])
        if not line:
            said = running.stderr.read().strip().splitlines()
            raise Unusable(f"the monitor can't be reached: {said[-1] if said else 'kubectl port-forward ended'}")
    raise Unusable(f"the monitor can't be reached: kubectl port-forward had not begun after {TIMEOUT:g} s")
