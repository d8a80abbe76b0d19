"""The API server through one kubectl that stays: where moments count, the start of a program for each question is too long."""

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

from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import TIMEOUT, Kubectl, said
from understudy.kube.client import Object


class Refused(CommandError):
    """The API server refused, with its words."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status
        """Of HTTP: 403 where it isn't allowed, 404 where it isn't there."""


@dataclass(frozen=True)
class Answer:
    """What the API server answered."""

    body: Object
    date: str
    """Its clock, in whole seconds, as HTTP has it."""
    asked: float
    answered: float
    """When it was asked and had answered, in unix seconds by this machine's clock."""


class Api:
    """Requests to the API server, one after the other."""

    def __init__(self, path: str) -> None:
        """``path`` is the socket of a ``kubectl proxy``."""
        self._path = path

    def get(self, path: str) -> Object:
        """An object, or a list of them. Raises Refused and CommandError."""
        return self.request("GET", path).body

    def request(self, method: str, path: str, body: Any = None, *, kind: str = "application/json") -> Answer:
        """One request; ``kind`` is the content type of its body. Raises Refused and CommandError."""
        connection = _Connection(self._path)
        asked = time.time()
        try:
            given = json.dumps(body) if body is not None else None
            connection.request(method, path, given, {"Content-Type": kind} if given else {})
            response = connection.getresponse()
            text = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise CommandError(f"the API server doesn't answer: {error}") from error
        finally:
            connection.close()
        answered = time.time()
        try:
            found = json.loads(text)
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
    """The API server, while the context lasts. Raises CommandError.

    Its socket is a file in a folder that is this user's alone: a port would let everybody on this machine in.
    """
    with tempfile.TemporaryDirectory(prefix="understudy-") as folder:
        path = f"{folder}/api"
        command = kubectl.command("proxy", f"--unix-socket={path}")
        # Ctrl-C is for this process only, which then still has to clear up.
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
    raise CommandError(f"kubectl proxy did not begin: {said(running.stderr.read()) or f'nothing after {TIMEOUT:g} s'}")
