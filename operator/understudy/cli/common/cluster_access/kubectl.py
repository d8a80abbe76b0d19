"""Runs kubectl for all requests to a cluster, so that every way to authenticate that kubectl supports works here too."""

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

from understudy.cli.common import option_rules, shell_completion
from understudy.cli.common.cluster_access.kubectl_watch import Watch, waiting
from understudy.cli.common.errors import CommandError, Forbidden
from understudy.kube.decoding import decode

TIMEOUT = 15.0
"""Seconds within which the API server must answer, and a port forwarding must start."""

PATIENCE = 1.0
"""Seconds after which the output of a running kubectl is shown: a credential plugin may display a login code or ask a question."""

WORKLOADS = "robotworkloads.understudy.dev"

_KIND = ("rw", "robotworkload", "robotworkloads", WORKLOADS)
"""How a user may write the kind in front of a name."""

_CREDENTIALS = "getting credentials: "
"""Part of kubectl's message if the kubeconfig's credential plugin failed. A plugin that asks questions needs a terminal."""

_LOG = re.compile(rb"[IWEF]\d{4} ")
"""The beginning of a line of kubectl's log. Messages for people do not have it."""

_REMEDIES = {
    "connection to the server localhost:8080 was refused": "kubectl found no kubeconfig and tried the default address; set --kubeconfig or "
    "KUBECONFIG",
    "did you specify the right host or port": "check that the API server runs, or choose another cluster with --context or --kubeconfig",
    "current-context must exist": "the kubeconfig has no current context; set --context, --kubeconfig or KUBECONFIG",
    "context was not found": "kubectl config get-contexts lists the available contexts",
    'context "': "kubectl config get-contexts lists the available contexts",
    "have a resource type": "Understudy is not installed in this cluster; install the chart, or choose another cluster with --context",
    _CREDENTIALS: "log in with the kubeconfig's credential plugin, for example by running kubectl get pods in a terminal",
    "Unauthorized": "the cluster does not accept your credentials; log in again, or choose another user with --context or --kubeconfig",
}
"""Remedies for messages of kubectl that name none, by a part of the message."""

_GUESS = " - did you specify the right host or port?"

_NO_CREDENTIALS = "the kubeconfig has no credentials for this cluster, and kubectl asked for a user; log in or choose another --context"
"""The meaning of kubectl's message ``EOF``: it asked a question on standard input, which is closed."""

_FORWARDING = re.compile(r"Forwarding from 127\.0\.0\.1:(\d+) ")


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Add the name of a RobotWorkload."""
    parser.add_argument("name", metavar="NAME", type=_robot, help="the RobotWorkload, such as robot-1 or rw/robot-1")


def add_robots(parser: argparse.ArgumentParser, *, required: bool = False) -> None:
    """Add the names of RobotWorkloads: at least one, or any number and the option to select them by labels (:func:`chosen`)."""
    if required:
        parser.add_argument(
            "names", metavar="NAME", type=_robot, nargs="+", help="a RobotWorkload, such as robot-1 or rw/robot-1"
        )
        return
    parser.add_argument("names", metavar="NAME", type=_robot, nargs="*", help="a RobotWorkload (default: all)")
    parser.add_argument(
        "-l", "--selector", help="only RobotWorkloads with these labels, such as app=navigation,site!=lab"
    )


def chosen(options: argparse.Namespace) -> list[str]:
    """Return the arguments with which kubectl gets the RobotWorkloads of :func:`add_robots`. Raises CommandError."""
    if options.names and options.selector:
        raise CommandError("give either names or -l/--selector: a name selects a RobotWorkload whatever its labels are")
    return ["-l", options.selector] if options.selector else list(options.names)


def add_dry_run(parser: argparse.ArgumentParser) -> None:
    """Add ``--dry-run``, which :class:`Kubectl` passes on with every change."""
    parser.add_argument(
        "--dry-run",
        choices=["none", "server"],
        default="none",
        help="server: the API server checks the change and stores nothing (default: none)",
    )


def _robot(text: str) -> str:
    """Return the name of a RobotWorkload, given with its kind or without, as for kubectl."""
    kind, _, name = text.rpartition("/")
    if kind.lower() not in ("", *_KIND):
        raise argparse.ArgumentTypeError(
            f"{kind!r} is not the kind RobotWorkload; give a name, such as robot-1 or rw/robot-1"
        )
    return name


def add_options(parser: argparse.ArgumentParser, *, all_namespaces: bool = False) -> None:
    """Add the options that choose the cluster and the namespace. Call it last: it also answers shell completion."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-n", "--namespace", help="namespace (default: that of the kubeconfig's context)")
    if all_namespaces:
        where.add_argument("-A", "--all-namespaces", action="store_true", help="all namespaces")
    parser.add_argument("--context", help="context of the kubeconfig")
    parser.add_argument("--kubeconfig", help="path of the kubeconfig")
    parser.add_argument("--as", dest="impersonated", metavar="USER", help="user to act as, if you may impersonate it")
    parser.add_argument(
        "--request-timeout",
        metavar="DURATION",
        type=option_rules.duration,
        default=TIMEOUT,
        help=f"how long a request to the API server may take, such as 1m (default: {TIMEOUT:g}s)",
    )
    completers = {
        "NAME": _completer(lambda kubectl: kubectl.names(WORKLOADS)),
        "NAMESPACE": _completer(lambda kubectl: kubectl.names("namespaces")),
        "CONTEXT": _completer(Kubectl.contexts),
        "SELECTOR": _completer(lambda kubectl: kubectl.labels(WORKLOADS)),
    }
    shell_completion.offer(parser, completers)


def _completer(names: Callable[[Kubectl], list[str]]) -> shell_completion.Completer:
    """Complete with these names, or with none if kubectl fails."""

    def complete(parsed_args: argparse.Namespace, **_: object) -> list[str]:
        try:
            return names(Kubectl(parsed_args))
        except CommandError:
            return []

    return complete


class Kubectl:
    """Runs kubectl for one cluster and one namespace."""

    def __init__(self, options: argparse.Namespace) -> None:
        """``options`` holds the options of :func:`add_options`. Raises CommandError if kubectl is not installed."""
        if shutil.which("kubectl") is None:
            raise CommandError("kubectl is not on the PATH; install it, because all requests to the cluster use it")
        given = vars(options)
        where = {"namespace": options.namespace, "context": options.context, "kubeconfig": options.kubeconfig}
        where["as"] = given.get("impersonated")
        self._options = [f"--{key}={value}" for key, value in where.items() if value]
        self._timeout: float = given.get("request_timeout") or TIMEOUT
        self.dry_run = given.get("dry_run") == "server"
        """Whether changes are only checked (:func:`add_dry_run`)."""
        self._namespace_option: str | None = options.namespace
        self._stdin: int | None = subprocess.DEVNULL
        """Closed, because nobody would see a question that kubectl itself asks, such as for a user name."""

    @property
    def namespace(self) -> str:
        """The given namespace, or that of the context. Raises CommandError with kubectl's message."""
        if not self._namespace_option:
            contexts = decode(self._run("config", "view", "--minify", "-o", "json")).get("contexts") or [{}]
            self._namespace_option = (contexts[0].get("context") or {}).get("namespace") or "default"
        return self._namespace_option

    def contexts(self) -> list[str]:
        """Return the names of the kubeconfig's contexts. Raises CommandError with kubectl's message."""
        return [one["name"] for one in decode(self._run("config", "view", "-o", "json")).get("contexts") or []]

    def names(self, kind: str) -> list[str]:
        """Return the names of the objects of a kind. Raises CommandError with kubectl's message."""
        return [item["metadata"]["name"] for item in self.get(kind)["items"]]

    def labels(self, kind: str) -> list[str]:
        """Return the labels of the objects of a kind, each as ``KEY=VALUE``. Raises CommandError with kubectl's message."""
        found = (item["metadata"].get("labels") or {} for item in self.get(kind)["items"])
        return sorted({f"{key}={value}" for labels in found for key, value in labels.items()})

    def command(self, *arguments: str) -> list[str]:
        """Return the command line of a kubectl process that runs in parallel to other requests."""
        return ["kubectl", *self._options, *arguments]

    def get(self, kind: str, *arguments: str) -> Any:
        """Return an object, or a list of objects. Raises CommandError with kubectl's message."""
        return decode(self._got(kind, *arguments))

    def find(self, kind: str, name: str, *arguments: str) -> Any:
        """Return an object, or None if it does not exist; for several names, a list of those that exist. Raises CommandError."""
        text = self._got(kind, name, *arguments, "--ignore-not-found")
        return decode(text) if text.strip() else None

    def patch(self, kind: str, name: str, body: Any) -> Any:
        """Change an object by a merge patch and return the result. Raises CommandError with kubectl's message."""
        asked = ["patch", kind, name, "--type=merge", "-p", json.dumps(body), "-o", "json"]
        return decode(self._run(*asked, *self._unstored()))

    def annotate(self, kind: str, name: str, note: str, value: str) -> None:
        """Set an annotation of an object. Raises CommandError with kubectl's message."""
        self._run("annotate", kind, name, "--overwrite", f"{note}={value}", *self._unstored())

    def shown(self, result: str) -> str:
        """Return a result, with a remark if nothing was stored, as kubectl prints it."""
        return f"{result} (server dry run: nothing was changed)" if self.dry_run else result

    def _unstored(self) -> list[str]:
        return ["--dry-run=server"] if self.dry_run else []

    def execute(self, pod: str, container: str, *program: str) -> str:
        """Run a program in a container and return its output. Raises CommandError with its message, or kubectl's."""
        command = self.command("exec", pod, "-c", container, "--", *program)
        try:
            done = subprocess.run(
                command, stdin=self._stdin, capture_output=True, text=True, timeout=2 * TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise CommandError(f"{program[0]} in pod {pod} did not finish within {error.timeout:g} s") from error
        if done.returncode:
            lines = [line for line in done.stderr.strip().splitlines() if not line.startswith("command terminated")]
            raise CommandError(
                lines[-1] if lines else f"{program[0]} in pod {pod} failed with exit status {done.returncode}"
            )
        return done.stdout

    def delete(self, kinds: str, *arguments: str) -> None:
        """Delete objects without waiting until they are gone. Raises CommandError with kubectl's message."""
        self._run("delete", kinds, *arguments, "--ignore-not-found", "--wait=false")

    def _got(self, kind: str, *arguments: str) -> str:
        return self._run("get", kind, *arguments, "-o", "json")

    def _run(self, *arguments: str) -> str:
        command = [*self.command(*arguments), f"--request-timeout={self._timeout:g}s"]
        status, output, errors = _run_command(command, self._stdin)
        if status and _CREDENTIALS in errors and self._stdin is not None and _is_interactive():
            self._stdin = None
            status, output, errors = _run_command(command, self._stdin)
        if status:
            refused = Forbidden if "Error from server (Forbidden)" in errors else CommandError
            raise refused(explain_failure(errors) or f"kubectl failed with exit status {status}")
        return output

    @contextlib.contextmanager
    def changes(
        self, kind: str, *arguments: str, also: Sequence[Sequence[str]] = ()
    ) -> Iterator[Callable[[float], bool]]:
        """Yield a function that waits up to the given seconds for a change of the objects and returns whether there was
        one.

        The function does not say what changed: the caller fetches all objects again. The watch restarts after the API
        server ends it. ``also`` are the kinds and arguments of further watches, for which the user may lack the
        permission.
        """

        watches = [
            Watch(self.command("get", *asked, "--watch-only", "-o", "name")) for asked in ((kind, *arguments), *also)
        ]
        with waiting(*watches) as wait:
            yield wait

    @contextlib.contextmanager
    def forwarded(self, pod: str, port: int) -> Iterator[int]:
        """Forward a port of this machine to a port of a pod, and yield it. Raises CommandError."""
        command = self.command("port-forward", f"pod/{pod}", f":{port}", "--address=127.0.0.1")
        with subprocess.Popen(
            command, stdin=self._stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as running:
            try:
                yield _port(running)
            finally:
                running.terminate()


def _is_interactive() -> bool:
    """Return whether a person can answer questions: not during shell completion."""
    # stdin is None if it was closed, as by `<&-`.
    return sys.stdin is not None and sys.stdin.isatty() and not shell_completion.is_asked()


def _run_command(command: Sequence[str], stdin: int | None) -> tuple[int, str, str]:
    """Run a command; return its exit status, output and error output. Error output of a slow command is shown meanwhile."""
    shown = received = 0
    with subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        try:
            while True:
                try:
                    output, errors = running.communicate(timeout=PATIENCE)
                except subprocess.TimeoutExpired as waiting:
                    errors = waiting.stderr or b""
                    _show(errors[shown:received])
                    shown, received = received, len(errors)
                else:
                    return running.returncode, output.decode(), errors.decode(errors="replace")
        except BaseException:
            running.kill()
            raise


def _show(errors: bytes) -> None:
    """Print error output except log lines. A question has no line break at its end."""
    words = b"".join(line for line in errors.splitlines(keepends=True) if not _LOG.match(line))
    print(words.decode(errors="replace"), end="", file=sys.stderr, flush=True)


def explain_failure(text: str) -> str:
    """Return the reason for a failure of kubectl from its last line of output, with what to do about it."""
    lines = text.strip().splitlines()
    message = lines[-1].removeprefix("error: ").removeprefix("Error in configuration: ") if lines else ""
    if message == "EOF":
        return _NO_CREDENTIALS
    remedy = next((text for part, text in _REMEDIES.items() if part in message), "")
    return f"{message.removesuffix(_GUESS)}: {remedy}" if remedy else message


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
                f"the monitor cannot be reached: {explain_failure(running.stderr.read()) or 'kubectl port-forward ended'}"
            )
    raise CommandError(f"the monitor cannot be reached: kubectl port-forward did not start within {TIMEOUT:g} s")
