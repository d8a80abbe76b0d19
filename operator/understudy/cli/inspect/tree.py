"""``understudy tree NAME``: shows a workload's live health tree, read from its monitor: in the terminal, as JSON or in a browser."""

from __future__ import annotations

import argparse
import contextlib
import http.client
import sys
import time
from collections.abc import Sequence
from typing import Any

from understudy.api import names
from understudy.api.output_formats import structured
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robot
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples, add_output
from understudy.cli.common.text import terminal
from understudy.cli.common.text.tree_text import Rates, lines
from understudy.controller.observed import kube_objects
from understudy.kube.decoding import decode

HEALTHY, NOT_HEALTHY = 0, 1
"""Exit statuses besides ERROR."""

PERIOD = 0.5
"""Seconds between two requests."""

PATIENCE = 20.0
"""Seconds for which requests to a monitor that does not answer are repeated with --watch: it may be restarting."""


@reports_errors("tree")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    try:
        kubectl = Kubectl(options)
        if options.web:
            return _web(kubectl, options.name)
        if options.watch:
            return _watch(kubectl, options.name)
        return _once(kubectl, options.name, options.output)
    except KeyboardInterrupt:
        return HEALTHY


def monitor_pod(kubectl: Kubectl, workload: str) -> str:
    """Return the pod of a workload's monitor. Raises CommandError."""
    kubectl.get("robotworkload", workload)  # fails if there is none of that name
    selector = f"{names.MONITORED}={workload},{names.COMPONENT}=monitor"
    pods = kubectl.get("pods", "-l", selector)["items"]
    running = [pod for pod in pods if kube_objects.ready(pod)]
    if running:
        return str(running[0]["metadata"]["name"])
    if not pods:
        raise CommandError(
            f"RobotWorkload {workload} has no monitor; see why: kubectl describe robotworkload {workload}, condition Accepted"
        )
    name, phase = pods[0]["metadata"]["name"], pods[0].get("status", {}).get("phase", "Unknown")
    raise CommandError(f"the monitor of {workload} is not ready ({phase}); see why: kubectl describe pod {name}")


def fetch_json(port: int, path: str = "/tree", *, what: str = "a live tree") -> dict[str, Any]:
    """Request a page of the monitor as JSON. Raises CommandError, also if the monitor's version does not serve ``what``."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        text = answer.read()
        if answer.status == 404:
            raise CommandError(
                f"the monitor's version does not support {what}; upgrade the operator, which replaces the monitor"
            )
        found: dict[str, Any] = decode(text)
        return found
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise CommandError(f"the monitor does not answer: {error}") from error
    finally:
        connection.close()


def _once(kubectl: Kubectl, workload: str, output: str) -> int:
    rates = Rates()
    with kubectl.forwarded(monitor_pod(kubectl, workload), names.METRICS_PORT) as port:
        state = fetch_json(port)
        if output == "text":
            rates.update(state)
            time.sleep(PERIOD)  # rates need two states
            state = fetch_json(port)
            rates.update(state)
    if output == "text":
        print("\n".join(lines(state, rates, colours=terminal.colours(sys.stdout))))
    else:
        print(structured(state, output))
    return HEALTHY if state["health"] == "Healthy" else NOT_HEALTHY


def _watch(kubectl: Kubectl, workload: str) -> int:
    """Redraw until Ctrl-C, also if the monitor is replaced meanwhile."""
    screen, colours = terminal.redraws(sys.stdout), terminal.colours(sys.stdout)
    rates, health = Rates(), ""
    answered = time.monotonic()
    try:
        with terminal.screen(sys.stdout) if screen else contextlib.nullcontext():
            while True:
                try:
                    with kubectl.forwarded(monitor_pod(kubectl, workload), names.METRICS_PORT) as port:
                        while True:
                            state = fetch_json(port)
                            answered = time.monotonic()
                            rates.update(state)
                            health = state["health"]
                            _draw(list(lines(state, rates, colours=colours)), screen)
                            time.sleep(PERIOD)
                except CommandError as error:
                    if time.monotonic() - answered > PATIENCE:
                        raise
                    _draw([f"{error}; retrying"], screen)
                    time.sleep(1)
    except (KeyboardInterrupt, BrokenPipeError):
        return HEALTHY if health == "Healthy" else NOT_HEALTHY


def _draw(lines_: Sequence[str], screen: bool) -> None:
    if screen:
        terminal.draw(sys.stdout, lines_)
    else:
        print("\n".join(lines_), end="\n\n", flush=True)


def _web(kubectl: Kubectl, workload: str) -> int:
    with kubectl.forwarded(monitor_pod(kubectl, workload), names.METRICS_PORT) as port:
        print(f"Serving the live tree at http://127.0.0.1:{port}/ until Ctrl-C.", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(PERIOD)
                fetch_json(port)
    return HEALTHY


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy tree",
        description="Shows the live health tree of a RobotWorkload as its monitor evaluates it: the state of each "
        "node, the rate of its topic, and why a node is not healthy. The command needs kubectl and the permission "
        "to forward ports to pods. It changes nothing.",
        epilog="Exit status: 0 if the workload is healthy, 1 if it is not, 2 if this cannot be determined.",
    )
    add_examples(parser, "understudy tree robot-1 -n fleet --watch", "understudy tree robot-1 --web")
    add_robot(parser)
    how = parser.add_mutually_exclusive_group()
    how.add_argument("-w", "--watch", action="store_true", help="keep updating until Ctrl-C")
    add_output(how)
    how.add_argument("--web", action="store_true", help="serve the monitor's own page on this machine until Ctrl-C")
    add_options(parser)
    return parser
