"""``understudy status``: shows robots and pools on one screen, once or after every change."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TextIO

from understudy.api import names
from understudy.api.output_formats import structured
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robots, chosen
from understudy.cli.common.errors import ERROR, CommandError, Forbidden, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.common.robots import Pool, Robot, pool, robot
from understudy.cli.common.text import terminal
from understudy.cli.inspect import status_screen
from understudy.cli.inspect.status_screen import Layout
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object
from understudy.kube.gates import registry

PROTECTED, NOT_PROTECTED = 0, 1
"""Exit statuses besides ERROR."""

NAMED = "robotworkload.understudy.dev"
"""What ``-o name`` puts in front of a name, as kubectl does."""

WORKLOADS, POOLS = "robotworkloads.understudy.dev", "fallbackpools.understudy.dev"

GATES = [resource.qualified for resource in registry.GATE_RESOURCES]
OURS = ["-l", ",".join(f"{key}={value}" for key, value in kube_objects.MANAGED_BY.items())]
"""Selects the objects that the operator created; the gates are among them."""

REFRESH = 10.0
"""Seconds after which everything is requested again without a change of a robot, because pools may have changed."""

LEAST_PAUSE = 0.5
"""Least seconds between two requests."""

TICK = 1.0
"""Seconds between two updates of the displayed ages."""

PATIENCE = 20.0
"""Seconds for which requests to an API server that does not answer are repeated with --watch."""


@reports_errors("status")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.watch and options.output in ("json", "yaml", "name"):
        parser.error(
            "-w cannot be combined with JSON, YAML or names; scripts can use kubectl wait --for=condition=Protected robotworkload/NAME"
        )
    try:
        kubectl = Kubectl(options)
        reader = _ClusterReader(kubectl, chosen(options), everywhere=options.all_namespaces)
        if options.watch:
            return _watch(reader, wide=options.output == "wide")
        return _once(reader, options.output)
    except (KeyboardInterrupt, BrokenPipeError):
        return ERROR


class _ClusterReader:
    """Requests robots, pools, and the gates if the user may read them."""

    def __init__(self, kubectl: Kubectl, chosen: Sequence[str], *, everywhere: bool) -> None:
        """``chosen`` are kubectl's arguments for some robots: their names, or a selector; all robots and pools without it."""
        self.kubectl, self.everywhere, self._chosen = kubectl, everywhere, chosen
        self._names = [] if "-l" in chosen else chosen
        self.where = ["-A"] if everywhere else []
        self._refused = -math.inf

    def __call__(self) -> tuple[list[Robot], list[Pool]]:
        """Return the current robots and pools. Raises CommandError, also if there is no robot."""
        # The gates first: otherwise a recovery that ends between the two requests would be shown as under way.
        gates = self._gates()
        kinds = WORKLOADS if self._chosen else f"{WORKLOADS},{POOLS}"
        found = self.kubectl.get(kinds, *self._chosen, *self.where)
        items = sorted(found.get("items", [found]), key=_key)
        now = time.time()
        robots = [
            robot(item, gates.get(_key(item, names.gate)), now) for item in items if item["kind"] == "RobotWorkload"
        ]
        if not robots:
            where = "the cluster" if self.everywhere else "this namespace (use -n NAMESPACE or -A)"
            which = f" with labels {self._chosen[1]}" if "-l" in self._chosen else ""
            raise CommandError(f"there is no RobotWorkload{which} in {where}")
        return robots, [pool(item) for item in items if item["kind"] == "FallbackPool"]

    def _gates(self) -> Mapping[tuple[str, str], Object]:
        """Return the gates by namespace and name, of all kinds or of the usual one.

        None if the user may not read them, which is tried again after a while.
        """
        if time.monotonic() < self._refused + REFRESH:
            return {}
        for kinds in (",".join(GATES), GATES[0]):
            with contextlib.suppress(Forbidden):
                if self._names:
                    found = self.kubectl.find(kinds, *map(names.gate, self._names), *self.where) or {"items": []}
                else:
                    found = self.kubectl.get(kinds, *OURS, *self.where)
                return {_key(item): item for item in found.get("items", [found])}
        self._refused = time.monotonic()
        return {}


def _key(item: Object, name: Callable[[str], str] = str) -> tuple[str, str]:
    """Return the namespace and the name of an object, or what a function makes of its name."""
    return item["metadata"]["namespace"], name(item["metadata"]["name"])


def _once(reader: _ClusterReader, output: str) -> int:
    robots, pools = reader()
    if output in ("json", "yaml"):
        written = {"robots": [one.to_wire() for one in robots], "pools": [one.to_wire() for one in pools]}
        print(structured(written, output))
    elif output == "name":
        print("\n".join(f"{NAMED}/{one.name}" for one in robots))
    else:
        print("\n".join(status_screen.lines(robots, pools, _layout(sys.stdout, reader, wide=output == "wide"))))
    return _exit_status(robots)


def _watch(reader: _ClusterReader, *, wide: bool) -> int:
    """Show every change until Ctrl-C. The exit status refers to what was shown last."""
    robots: list[Robot] = []
    answered = time.monotonic()
    screen = terminal.redraws(sys.stdout)
    shown = _Screen(reader, wide=wide) if screen else _Lines()
    taken = terminal.screen(sys.stdout) if screen else contextlib.nullcontext()
    try:
        where = reader.where
        with (
            taken,
            reader.kubectl.changes(WORKLOADS, *where, also=[[gates, *OURS, *where] for gates in GATES]) as changed,
        ):
            while True:
                asked = time.monotonic()
                try:
                    robots, pools = reader()
                    answered = asked
                    shown.show(robots, pools)
                except CommandError as error:
                    if not robots or asked - answered > PATIENCE:
                        raise
                    shown.warn(f"{error}; retrying")
                while not changed(TICK) and time.monotonic() - asked < REFRESH:
                    shown.tick()
                time.sleep(max(0.0, asked + LEAST_PAUSE - time.monotonic()))
    except (KeyboardInterrupt, BrokenPipeError):
        return _exit_status(robots) if robots else ERROR


class _Screen:
    """The whole screen of a terminal, redrawn if its content changed."""

    def __init__(self, reader: _ClusterReader, *, wide: bool) -> None:
        self._reader, self._wide = reader, wide
        self._robots: Sequence[Robot] = ()
        self._pools: Sequence[Pool] = ()
        self._warning = ""
        self._drawn: tuple[object, ...] = ()

    def show(self, robots: Sequence[Robot], pools: Sequence[Pool]) -> None:
        """Show the current state."""
        self._robots, self._pools, self._warning = robots, pools, ""
        self.tick()

    def warn(self, words: str) -> None:
        """Show the last known state with a warning."""
        self._warning = words
        self.tick()

    def tick(self) -> None:
        """Update ages and window size."""
        layout = _layout(sys.stdout, self._reader, wide=self._wide)
        layout = replace(layout, columns=terminal.size()[0] - 1)  # a full row loses its last character
        written = [*([self._warning, ""] if self._warning else [])]
        if self._robots:
            written += status_screen.screenful(self._robots, self._pools, layout, terminal.rows() - len(written))
        screen = (tuple(written), terminal.size())
        if screen != self._drawn:
            terminal.draw(sys.stdout, written)
            self._drawn = screen


class _Lines:
    """One line per changed robot, for output that cannot be redrawn."""

    def __init__(self) -> None:
        self._written: dict[tuple[str, str], str] = {}

    def show(self, robots: Sequence[Robot], pools: Sequence[Pool]) -> None:
        """Print the robots that changed or are gone."""
        now = {(one.namespace, one.name): status_screen.in_a_line(one) for one in robots}
        for key, line in now.items():
            if self._written.get(key) != line:
                self._print(line)
        for namespace, name in self._written.keys() - now.keys():
            self._print(f"{namespace}/{name}; deleted")
        self._written = now

    def warn(self, words: str) -> None:
        """Print the warning."""
        self._print(words)

    def tick(self) -> None:
        """Do nothing: printed lines do not age."""

    def _print(self, line: str) -> None:
        print(time.strftime("%H:%M:%SZ", time.gmtime()), line, flush=True)


def _layout(out: TextIO, reader: _ClusterReader, *, wide: bool) -> Layout:
    return Layout(
        now=time.time(),
        columns=terminal.columns(out),
        colours=terminal.colours(out),
        namespaces=reader.everywhere,
        wide=wide,
    )


def _exit_status(robots: Sequence[Robot]) -> int:
    return PROTECTED if all(one.is_well for one in robots) else NOT_PROTECTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy status",
        description="Shows the robots and pools of a namespace: the active instance, ready standbys, the last recovery, and "
        "problems. It reads the status that operator and monitors write. A recovery in progress is recorded at the gate first, and "
        "shown if you have permission to list NetworkPolicies, or Leases for robots with a mux. The command changes nothing.",
        epilog="Exit status: 0 if every robot shown is protected (the monitor watches it, and the first strategy of its policy could run "
        "now) and healthy (or degraded), 1 if one is not, 2 on an error or if there is none.",
    )
    add_examples(parser, "understudy status -n fleet", "understudy status -A -l app=navigation --watch")
    add_robots(parser)
    parser.add_argument("-w", "--watch", action="store_true", help="keep updating until Ctrl-C")
    parser.add_argument(
        "-o",
        "--output",
        choices=["text", "wide", "json", "yaml", "name"],
        default="text",
        help="text, text with more columns, all details as JSON or YAML, or only the names of the robots, as kubectl prints them",
    )
    add_options(parser, all_namespaces=True)
    return parser
