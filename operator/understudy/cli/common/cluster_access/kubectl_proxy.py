"""Requests to the API server through one ``kubectl proxy``, for callers that cannot wait for a new process per request."""

from __future__ import annotations

import contextlib
import http.client
import json
import select
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from understudy.cli.common.cluster_access.kubectl import TIMEOUT, Kubectl, explain_failure
from understudy.cli.common.errors import CommandError
from understudy.kube.client import Object
from understudy.kube.decoding import decode


class Refused(CommandError):
    """The API server refused a request. The message is its own."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status
        """The HTTP status: 403 if forbidden, 404 if not found."""


@dataclass(frozen=True)
class Answer:
    """An answer of the API server."""

    body: Object
    date: str
    """The ``Date`` header: the server's clock in whole seconds."""
    asked: float
    answered: float
    """When the request was sent and the answer received, in unix seconds of this machine's clock."""


class Api:
    """Sends requests to the API server, one at a time."""

    def __init__(self, path: str) -> None:
        """``path`` is the unix socket of a ``kubectl proxy``."""
        self._path = path

    def get(self, path: str) -> Object:
        """Return an object, or a list of objects. Raises Refused and CommandError."""
        return self.request("GET", path).body

    def request(self, method: str, path: str, body: Any = None, *, kind: str = "application/json") -> Answer:
        """Send one request; ``kind`` is the content type of its body. Raises Refused and CommandError."""
        connection = _Connection(self._path)
        asked = time.time()
        try:
            payload = json.dumps(body) if body is not None else None
            connection.request(method, path, payload, {"Content-Type": kind} if payload else {})
            response = connection.getresponse()
            text = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise CommandError(f"the API server does not answer: {error}") from error
        finally:
            connection.close()
        answered = time.time()
        try:
            found = decode(text)
        except ValueError:
            found = {"message": text.decode(errors="replace").strip()[:300]}
        if response.status >= 300:
            raise Refused(response.status, found.get("message") or response.reason)
        return Answer(found, response.headers.get("Date") or "", asked, answered)


class _Connection(http.client.HTTPConnection):
    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=TIMEOUT)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


@contextlib.contextmanager
def proxied(kubectl: Kubectl) -> Iterator[Api]:
    """Start a ``kubectl proxy`` for the duration of the context. Raises CommandError.

    It listens on a unix socket in a private folder: a TCP port would give every user of this machine access.
    """
    with tempfile.TemporaryDirectory(prefix="understudy-") as folder:
        path = f"{folder}/api"
        command = kubectl.command("proxy", f"--unix-socket={path}")
        # Ctrl-C must reach this process only, which still has to clean up.
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        ) as running:
            try:
                _wait(running)
                yield Api(path)
            finally:
                running.terminate()


def _wait(running: subprocess.Popen[str]) -> None:
    assert running.stdout is not None, "it is a pipe"
    assert running.stderr is not None, "it is a pipe"
    if select.select([running.stdout], [], [], TIMEOUT)[0] and "Starting to serve" in running.stdout.readline():
        return
    running.terminate()
    raise CommandError(
        f"kubectl proxy did not start: {explain_failure(running.stderr.read()) or f'no output within {TIMEOUT:g} s'}"
    )
