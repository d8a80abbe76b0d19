"""What is asked of a cluster goes through kubectl: whoever has access by it has access here, however they prove who they are."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from understudy.cli.common import shell_completion
from understudy.cli.common.errors import CommandError, Forbidden
from understudy.cli.common.kubectl_watch import Watch, waiting

TIMEOUT = 15.0
"""Seconds that the API server has to answer, and a forwarding to begin."""

PATIENCE = 1.0
"""Seconds that kubectl goes on for before what it has said is shown: a plugin may have told a code to log in by, or asked for something."""

WORKLOADS = "robotworkloads.understudy.dev"

_CREDENTIALS = "getting credentials: "
"""Part of what kubectl says where the kubeconfig's plugin gave none: one that asks for something has to have a terminal."""

_LOG = re.compile(rb"[IWEF]\d{4} ")
"""How lines of kubectl's log begin: each is followed by what is meant for people."""

_WAYS_OUT = {
    "connection to the server localhost:8080 was refused": "no kubeconfig was found, so kubectl asked there; name yours by --kubeconfig or "
    "KUBECONFIG",
    "did you specify the right host or port": "look whether its API server runs, or name another cluster by --context or --kubeconfig",
    "current-context must exist": "the kubeconfig says no context; name one by --context, or a kubeconfig by --kubeconfig or KUBECONFIG",
    "context was not found": "kubectl config get-contexts lists those that there are",
    'context "': "kubectl config get-contexts lists those that there are",
    "have a resource type": "the definitions of Understudy aren't in this cluster; install the chart, or name another cluster by --context",
    _CREDENTIALS: "log in as the kubeconfig's plugin has it, such as by kubectl get pods in a terminal, where it can ask",
    "Unauthorized": "the cluster doesn't know who you are; log in anew, or name another user's --context or --kubeconfig",
}
"""What to do about what kubectl says that names nothing to do, by a part of it."""

_GUESS = " - did you specify the right host or port?"

_NOBODY = "the kubeconfig has no credentials for this cluster, so kubectl asked for a user name; log in, or name another --context"
"""What it is where kubectl says ``EOF``: it asks on standard input, of which there is none."""

_FORWARDING = re.compile(r"Forwarding from 127\.0\.0\.1:(\d+) ")


def add_options(parser: argparse.ArgumentParser, *, all_namespaces: bool = False) -> None:
    """Let a command be told which cluster and which namespace is meant. The last thing that its parser is given."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-n", "--namespace", help="the namespace, where that isn't the context's")
    if all_namespaces:
        where.add_argument("-A", "--all-namespaces", action="store_true", help="every namespace")
    parser.add_argument("--context", help="the kubeconfig's context")
    parser.add_argument("--kubeconfig", help="the kubeconfig")
    shell_completion.offer(parser, {"NAME": _robots, "NAMESPACE": _namespaces, "CONTEXT": _contexts})


def _robots(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """The names of RobotWorkloads, for a shell."""
    return _named(parsed_args, WORKLOADS)


def _namespaces(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """The names of namespaces, for a shell."""
    return _named(parsed_args, "namespaces")


def _named(given: argparse.Namespace, kind: str) -> list[str]:
    try:
        return [item["metadata"]["name"] for item in Kubectl(given).get(kind)["items"]]
    except CommandError:
        return []


def _contexts(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """The contexts of the kubeconfig, for a shell."""
    try:
        return Kubectl(parsed_args).contexts()
    except CommandError:
        return []


class Kubectl:
    """kubectl with the options that say which cluster and which namespace."""

    def __init__(self, given: argparse.Namespace) -> None:
        """``given`` are the options of :func:`add_options`. Raises CommandError where there is no kubectl."""
        if shutil.which("kubectl") is None:
            raise CommandError("kubectl isn't on the PATH; install it, since the cluster is asked through it")
        where = {"namespace": given.namespace, "context": given.context, "kubeconfig": given.kubeconfig}
        self._options = [f"--{key}={value}" for key, value in where.items() if value]
        self._given: str | None = given.namespace
        self._stdin: int | None = subprocess.DEVNULL
        """Nothing that it could read: of what kubectl itself asks for, such as a user's name, nobody would see the question."""

    @property
    def namespace(self) -> str:
        """The namespace that is meant: the one given, or the context's. Raises CommandError with what kubectl said."""
        if not self._given:
            contexts = json.loads(self._run("config", "view", "--minify", "-o", "json")).get("contexts") or [{}]
            self._given = (contexts[0].get("context") or {}).get("namespace") or "default"
        return self._given

    def contexts(self) -> list[str]:
        """The names of the kubeconfig's contexts. Raises CommandError with what kubectl said."""
        return [one["name"] for one in json.loads(self._run("config", "view", "-o", "json")).get("contexts") or []]

    def command(self, *arguments: str) -> list[str]:
        """The command line of a kubectl that goes on while others are asked."""
        return ["kubectl", *self._options, *arguments]

    def get(self, kind: str, *arguments: str) -> Any:
        """An object, or a list of them. Raises CommandError with what kubectl said."""
        return json.loads(self._got(kind, *arguments))

    def find(self, kind: str, name: str, *arguments: str) -> Any:
        """An object, or None where it isn't there; of several names a list of those that are. Raises CommandError."""
        text = self._got(kind, name, *arguments, "--ignore-not-found")
        return json.loads(text) if text.strip() else None

    def patch(self, kind: str, name: str, body: Any) -> Any:
        """Change an object by a merge patch; the object as it is then. Raises CommandError with what kubectl said."""
        return json.loads(self._run("patch", kind, name, "--type=merge", "-p", json.dumps(body), "-o", "json"))

    def annotate(self, kind: str, name: str, note: str, value: str) -> None:
        """Write an annotation of an object, over what it was. Raises CommandError with what kubectl said."""
        self._run("annotate", kind, name, "--overwrite", f"{note}={value}")

    def execute(self, pod: str, container: str, *program: str) -> str:
        """Run a program in a container; what it wrote. Raises CommandError with what it, or kubectl, said."""
        command = self.command("exec", pod, "-c", container, "--", *program)
        try:
            done = subprocess.run(
                command, stdin=self._stdin, capture_output=True, text=True, timeout=2 * TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise CommandError(f"{program[0]} in pod {pod} had not ended after {error.timeout:g} s") from error
        if done.returncode:
            lines = [line for line in done.stderr.strip().splitlines() if not line.startswith("command terminated")]
            raise CommandError(lines[-1] if lines else f"{program[0]} in pod {pod} ended with {done.returncode}")
        return done.stdout

    def delete(self, kinds: str, *arguments: str) -> None:
        """Delete objects, without waiting until they are gone. Raises CommandError with what kubectl said."""
        self._run("delete", kinds, *arguments, "--ignore-not-found", "--wait=false")

    def _got(self, kind: str, *arguments: str) -> str:
        return self._run("get", kind, *arguments, "-o", "json")

    def _run(self, *arguments: str) -> str:
        command = [*self.command(*arguments), f"--request-timeout={TIMEOUT:g}s"]
        status, output, told = _done(command, self._stdin)
        if status and _CREDENTIALS in told and self._stdin is not None and _somebody_answers():
            self._stdin = None
            status, output, told = _done(command, self._stdin)
        if status:
            refused = Forbidden if "Error from server (Forbidden)" in told else CommandError
            raise refused(said(told) or f"kubectl ended with {status}")
        return output

    @contextlib.contextmanager
    def changes(self, kind: str, *arguments: str, also: Sequence[str] = ()) -> Iterator[Callable[[float], bool]]:
        """While the context lasts, waits at most so many seconds for the objects of a kind to change; whether they did.

        It tells that they did and not how: whoever is told asks for all of them again. Where the watch ends, as API servers end every
        one after a while, it is begun anew. ``also`` are the kind and the arguments of another watch, which isn't missed where whoever
        asks hasn't the right to it.
        """

        watches = [
            Watch(self.command("get", *asked, "--watch-only", "-o", "name"))
            for asked in ((kind, *arguments), also)
            if asked
        ]
        with waiting(*watches) as wait:
            yield wait

    @contextlib.contextmanager
    def forwarded(self, pod: str, port: int) -> Iterator[int]:
        """A port on this machine that leads to one of a pod, while the context lasts. Raises CommandError."""
        command = self.command("port-forward", f"pod/{pod}", f":{port}", "--address=127.0.0.1")
        with subprocess.Popen(
            command, stdin=self._stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as running:
            try:
                yield _port(running)
            finally:
                running.terminate()


def _somebody_answers() -> bool:
    """Whether there is somebody who could be asked: not where a shell wants to know how a line may go on."""
    # There is none at all where it was closed, as by `<&-`.
    return sys.stdin is not None and sys.stdin.isatty() and not shell_completion.is_asked()


def _done(command: Sequence[str], stdin: int | None) -> tuple[int, str, str]:
    """The exit status of a command, what it wrote, and what it said. What it said a while ago and goes on after is shown meanwhile."""
    shown = heard = 0
    with subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        try:
            while True:
                try:
                    output, told = running.communicate(timeout=PATIENCE)
                except subprocess.TimeoutExpired as waiting:
                    told = waiting.stderr or b""
                    _show(told[shown:heard])
                    shown, heard = heard, len(told)
                else:
                    return running.returncode, output.decode(), told.decode(errors="replace")
        except BaseException:
            running.kill()
            raise


def _show(told: bytes) -> None:
    """Pass on what isn't of a log; a question has no end of line."""
    words = b"".join(line for line in told.splitlines(keepends=True) if not _LOG.match(line))
    print(words.decode(errors="replace"), end="", file=sys.stderr, flush=True)


def said(text: str) -> str:
    """Why kubectl couldn't do it, by the last line of what it wrote, and what to do where that alone doesn't say it."""
    lines = text.strip().splitlines()
    told = lines[-1].removeprefix("error: ").removeprefix("Error in configuration: ") if lines else ""
    if told == "EOF":
        return _NOBODY
    way_out = next((way for part, way in _WAYS_OUT.items() if part in told), "")
    return f"{told.removesuffix(_GUESS)}: {way_out}" if way_out else told


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
            raise CommandError(
                f"the monitor can't be reached: {said(running.stderr.read()) or 'kubectl port-forward ended'}"
            )
    raise CommandError(f"the monitor can't be reached: kubectl port-forward had not begun after {TIMEOUT:g} s")
