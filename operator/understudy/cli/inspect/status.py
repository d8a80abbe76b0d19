"""``understudy status``: robots and pools on one screen; once, or again with every change."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TextIO

from understudy.api import names
from understudy.api.output_formats import structured
from understudy.cli.common import terminal
from understudy.cli.common.errors import CommandError, Forbidden
from understudy.cli.common.kubectl import Kubectl, add_options
from understudy.cli.common.robots import Pool, Robot, pool, robot
from understudy.cli.inspect import status_screen
from understudy.cli.inspect.status_screen import Look
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object
from understudy.kube.gates import registry

PROTECTED, NOT_PROTECTED, CANT = 0, 1, 2
"""Exit statuses."""

WORKLOADS, POOLS = "robotworkloads.understudy.dev", "fallbackpools.understudy.dev"

GATES = ",".join(resource.qualified for resource in registry.GATE_RESOURCES)
OURS = ["-l", ",".join(f"{key}={value}" for key, value in kube_objects.MANAGED_BY.items())]
"""Which of them: the gates are among those that the operator has made."""

AGAIN = 10.0
"""Seconds after which all is asked for anew though no robot is said to have changed: pools may have."""

APART = 0.5
"""Least seconds between two questions, however much changes."""

TICK = 1.0
"""Seconds between two looks at the clock: times that have passed are told in seconds."""

PATIENCE = 20.0
"""Seconds for which an API server that doesn't answer is asked again while it is watched."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.watch and given.output in ("json", "yaml"):
        parser.error(
            "-w is for people; what waits for a robot can use kubectl wait --for=condition=Protected robotworkload/NAME"
        )
    try:
        kubectl = Kubectl(given)
        asking = _Asking(kubectl, given.names, everywhere=given.all_namespaces)
        if given.watch:
            return _watch(asking, wide=given.output == "wide")
        return _once(asking, given.output)
    except CommandError as error:
        print(f"understudy status: {error}", file=sys.stderr)
        return CANT
    except (KeyboardInterrupt, BrokenPipeError):
        return CANT


class _Asking:
    """Asks for robots, with their gates where these may be read, and pools."""

    def __init__(self, kubectl: Kubectl, names: Sequence[str], *, everywhere: bool) -> None:
        self.kubectl, self.everywhere, self._names = kubectl, everywhere, names
        self.where = ["-A"] if everywhere else []
        self._refused = -math.inf

    def __call__(self) -> tuple[list[Robot], list[Pool]]:
        """How they are now. Raises CommandError, also where there is none."""
        # The gates first: what one tells of, a status that is read after it may tell of by then, and what is over isn't under way.
        gates = self._gates()
        kinds = WORKLOADS if self._names else f"{WORKLOADS},{POOLS}"
        found = self.kubectl.get(kinds, *self._names, *self.where)
        items = sorted(
            found.get("items", [found]), key=lambda item: (item["metadata"]["namespace"], item["metadata"]["name"])
        )
        now = time.time()
        robots = [robot(item, gates.get(_gate_of(item)), now) for item in items if item["kind"] == "RobotWorkload"]
        if not robots:
            where = "the cluster" if self.everywhere else "this namespace (-n NAMESPACE and -A ask elsewhere)"
            raise CommandError(f"there is no RobotWorkload in {where}")
        return robots, [pool(item) for item in items if item["kind"] == "FallbackPool"]

    def _gates(self) -> Mapping[tuple[str, str], Object]:
        """The gates by namespace and name; none where they may not be read, which is tried again after a while only."""
        if time.monotonic() < self._refused + AGAIN:
            return {}
        try:
            if self._names:
                found = self.kubectl.find(GATES, *map(names.gate, self._names), *self.where) or {"items": []}
            else:
                found = self.kubectl.get(GATES, *OURS, *self.where)
        except Forbidden:
            self._refused = time.monotonic()
            return {}
        return {_key(item["metadata"], item["metadata"]["name"]): item for item in found.get("items", [found])}


def _gate_of(workload: Object) -> tuple[str, str]:
    return _key(workload["metadata"], names.gate(workload["metadata"]["name"]))


def _key(metadata: Object, name: str) -> tuple[str, str]:
    return metadata["namespace"], name


def _once(asking: _Asking, output: str) -> int:
    robots, pools = asking()
    if output in ("json", "yaml"):
        told = {"robots": [one.to_wire() for one in robots], "pools": [one.to_wire() for one in pools]}
        print(structured(told, output))
    else:
        print("\n".join(status_screen.lines(robots, pools, _look(sys.stdout, asking, wide=output == "wide"))))
    return _exit_status(robots)


def _watch(asking: _Asking, *, wide: bool) -> int:
    """Show it again whenever it has changed, until Ctrl-C. The exit status is of what was shown last."""
    robots: list[Robot] = []
    answered = time.monotonic()
    screen = sys.stdout.isatty()
    shown = _Screen(asking, wide=wide) if screen else _Lines()
    taken = terminal.screen(sys.stdout) if screen else contextlib.nullcontext()
    try:
        where = asking.where
        with taken, asking.kubectl.changes(WORKLOADS, *where, also=[GATES, *OURS, *where]) as changed:
            while True:
                asked = time.monotonic()
                try:
                    robots, pools = asking()
                    answered = asked
                    shown.show(robots, pools)
                except CommandError as error:
                    if not robots or asked - answered > PATIENCE:
                        raise
                    shown.trouble(f"{error}; asking again")
                while not changed(TICK) and time.monotonic() - asked < AGAIN:
                    shown.tick()
                time.sleep(max(0.0, asked + APART - time.monotonic()))
    except (KeyboardInterrupt, BrokenPipeError):
        return _exit_status(robots) if robots else CANT


class _Screen:
    """The whole screen of a terminal, written anew where anything on it is another."""

    def __init__(self, asking: _Asking, *, wide: bool) -> None:
        self._asking, self._wide = asking, wide
        self._robots: Sequence[Robot] = ()
        self._pools: Sequence[Pool] = ()
        self._trouble = ""
        self._drawn: tuple[object, ...] = ()

    def show(self, robots: Sequence[Robot], pools: Sequence[Pool]) -> None:
        """Show them as they are."""
        self._robots, self._pools, self._trouble = robots, pools, ""
        self.tick()

    def trouble(self, words: str) -> None:
        """Show what is known, and that it may not be so any more."""
        self._trouble = words
        self.tick()

    def tick(self) -> None:
        """Show it with the present time, in a window that may be of another size now."""
        look = _look(sys.stdout, self._asking, wide=self._wide)
        look = replace(look, columns=terminal.size()[0] - 1)  # of a full row the last character is lost
        told = [*([self._trouble, ""] if self._trouble else [])]
        if self._robots:
            told += status_screen.screenful(self._robots, self._pools, look, terminal.rows() - len(told))
        screen = (tuple(told), terminal.size())
        if screen != self._drawn:
            terminal.draw(sys.stdout, told)
            self._drawn = screen


class _Lines:
    """One line for each robot that has changed, where nothing can be written anew."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], str] = {}

    def show(self, robots: Sequence[Robot], pools: Sequence[Pool]) -> None:
        """Print those that are another now, and those that are gone."""
        now = {(one.namespace, one.name): status_screen.in_a_line(one) for one in robots}
        for key, line in now.items():
            if self._told.get(key) != line:
                self._print(line)
        for namespace, name in self._told.keys() - now.keys():
            self._print(f"{namespace}/{name}; is gone")
        self._told = now

    def trouble(self, words: str) -> None:
        """Print it."""
        self._print(words)

    def tick(self) -> None:
        """Time that passes changes nothing that is printed."""

    def _print(self, line: str) -> None:
        print(time.strftime("%H:%M:%SZ", time.gmtime()), line, flush=True)


def _look(out: TextIO, asking: _Asking, *, wide: bool) -> Look:
    return Look(
        now=time.time(),
        columns=terminal.columns(out),
        colours=terminal.colours(out),
        namespaces=asking.everywhere,
        wide=wide,
    )


def _exit_status(robots: Sequence[Robot]) -> int:
    return PROTECTED if all(one.is_well for one in robots) else NOT_PROTECTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy status",
        description="Shows the robots of a namespace: who is in control, which standbys are ready, the last recovery, and what is "
        "wrong; and the pools. All of it is what operator and monitors have said in the objects' status; that a robot is being recovered "
        "its gate tells sooner, if you may read it. It acts on nothing.",
        epilog="Exit status: 0 where every robot that is shown is protected and healthy (or degraded, which is driven too), 1 where "
        "one isn't, 2 where it can't be told or there is none.",
    )
    parser.add_argument("names", metavar="NAME", nargs="*", help="a RobotWorkload; all where none is named")
    parser.add_argument("-w", "--watch", action="store_true", help="go on until Ctrl-C, and show every change")
    parser.add_argument(
        "-o",
        "--output",
        choices=["text", "wide", "json", "yaml"],
        default="text",
        help="text, text with more columns, or everything as JSON or YAML",
    )
    add_options(parser, all_namespaces=True)
    return parser
