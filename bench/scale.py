"""Measures operator, monitors and API server with a fleet of many robots, and how their figures grow with the number of
robots.

    scripts/bench scale [--robots 1000] [--pool 100] [--fleet 100] [--rate 100] [--seconds 10] [--pictures docs/images]

The bench has its own control plane: a real API server, controllers and scheduler; kwok simulates nodes and pods. The
operator runs as its usual process. Monitors share some processes: each has the real code of views, claims, gates and
recoveries, and its own account, connections and watches. Each fleet has a namespace and a pool of --pool pods. At a
tenth, three tenths and all of --robots the bench measures: the fleet at rest, --burst failures at once, failures and
claims that come independently of each other (open-loop: times count from when each was due), and a start of the
operator with all objects. docs/scale.md lists what is simulated, and says what the figures mean.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.load import priority
from bench.results import Report, quantile
from bench.roles import Role
from bench.scaling import cluster, counting, pictures
from bench.scaling.arrivals import poisson, spread
from bench.scaling.counting import Reading
from bench.scaling.exposition import Reading as Own
from bench.scaling.fleets import Fleet, Robot, fleets
from bench.scaling.growth import exponent, extrapolated
from bench.scaling.operating import MISSED, RESYNC, Operator, Usage

CLAIM_P99, WRITES_MOST, CPU_MOST, MEMORY_MOST, START_MOST = 300.0, 6.0, 100.0, 250.0, 60.0
RESYNC_MOST = START_MOST
"""The bounds: ms, API writes per failover, milli-CPU and MB at rest, seconds."""

SETTLED = 1200.0
"""Maximum seconds that the bench waits for a fleet to be built, or to recover."""

CALM = 12.0
"""Seconds without a write before something is measured: longer than the period of a simulated monitor."""

CLAIMED = 0.8
"""Maximum share of a pool's pods that the bench claims. How long a robot waits for the next pod is another question."""

LARGE = 10_000
"""Number of robots for which figures are extrapolated."""

CHUNK = 100
"""Robots that a process of monitors receives in one line."""

NODES = "BENCH_SCALE_CONFIG"
"""Environment variable with the configuration of a monitors' process for the API server."""


@dataclass
class Found:
    """The results for a number of robots."""

    robots: int
    built: float = 0.0
    """Seconds until the fleets that were added last were built and driven."""
    rest: Usage | None = None
    resync: float = 0.0
    """Seconds that the operator's last list of everything took."""
    rest_writes: dict[str, float] = field(default_factory=dict)
    """The writes of the whole rest, by account and kind."""
    rest_counted: Reading | None = None
    watches: float = 0.0
    server_memory: float = 0.0
    """Memory of the API server, in MB."""
    recoveries: list[float] = field(default_factory=list)
    """Seconds from each failure of the burst until the robot was driven again."""
    burst: int = 0
    burst_writes: dict[str, dict[str, float]] = field(default_factory=dict)
    """The writes per failover, by account and kind."""
    failed: list[float] = field(default_factory=list)
    """Seconds of recoveries from failures that occurred independently of each other."""
    loaded: Usage | None = None
    writes: dict[str, dict[str, float]] = field(default_factory=dict)
    """The writes per failover, by account and kind."""
    reads: float = 0.0
    events: float = 0.0
    """Events and MB that watches sent, per failover."""
    bytes: float = 0.0
    unrecovered: int = 0
    others: list[str] = field(default_factory=list)
    """Recoveries by another strategy than the pool, and failed ones."""
    claims: list[float] = field(default_factory=list)
    """ms from the planned time of each claim until it was acknowledged."""
    retried: float = 0.0
    """Claims per claim that another robot won."""
    double: int = 0
    lost: int = 0
    claiming: dict[str, float] = field(default_factory=dict)
    """Seconds of processor time per claim, by process, from the first claim until all were answered."""
    claim_reads: float = 0.0
    """Reads of the monitors, per claim."""
    claim_writes: dict[str, dict[str, float]] = field(default_factory=dict)
    """The writes per claim, by account and kind."""
    claim_events: float = 0.0
    """Events that watches sent meanwhile, per claim."""
    claim_collections: float = 0.0
    """How often the API server collected its garbage meanwhile."""
    refilled: float = 0.0
    """Seconds until the pools were full again after the claims."""
    start: float = 0.0
    """Seconds from the operator's start until it had processed everything."""
    start_writes: dict[str, float] = field(default_factory=dict)
    dry_runs: float = 0.0
    start_memory: float = 0.0
    missed: float = 0.0
    """Changes that the operator learned only from a list."""
    restarts: int = 0
    """How often the operator ended by itself, and was started again."""


class Bench:
    """One run."""

    def __init__(self, options: argparse.Namespace, made: cluster.Cluster, monitors: Sequence[Role]) -> None:
        self._options, self._cluster, self._monitors = options, made, monitors
        self._random = random.Random(options.seed)
        self._begun = time.monotonic()
        self._where: dict[str, Role] = {}
        self._robots: list[Robot] = []
        self._pods = 0
        self._log = made.folder / "operator.log"
        self._operator_config = made.operator_kubeconfig()

    def run(self) -> Iterator[list[Found]]:
        """Measure at every size, and yield the results so far after each."""
        all_of_them = fleets(self._options.robots, self._options.fleet)
        self._cluster.count_apart(all_of_them)
        found = []
        there: list[Fleet] = []
        for size in self._options.sizes:
            wanted = [fleet for fleet in all_of_them if int(fleet.robots[-1].name.split("-")[-1]) < size]
            more, there = wanted[len(there) :], wanted
            with self._operator() as operator:
                one = Found(sum(len(fleet.robots) for fleet in wanted))
                self._grow(one, more, operator)
                self._rest(one, operator)
                if not self._options.only_rest:
                    self._burst(one)
                    self._fail(one, operator)
                    self._claim(one, operator)
                one.missed = self._own(operator).total(MISSED)
                one.restarts = operator.restarts
            self._restart(one)
            found.append(one)
            yield found

    # -- parts of a run ---------------------------------------------------------------------------------------------

    def _grow(self, one: Found, more: Sequence[Fleet], operator: Operator) -> None:
        robots = [robot for fleet in more for robot in fleet.robots]
        self.say(f"{one.robots} robots: making {len(robots)} in {len(more)} fleets")
        begun = time.monotonic()
        self._cluster.add(more, self._options.pool)
        self._robots += robots
        self._pods += self._options.pool * len(more)
        self._until(lambda: self._cluster.built() == (len(self._robots), self._pods), "everything to be built")
        self.say(f"{one.robots} robots: built after {time.monotonic() - begun:.0f} s, starting their monitors")
        tokens = self._cluster.tokens(robots)
        for number, role in enumerate(self._monitors):
            mine = tokens[number :: len(self._monitors)]
            self._where |= {f"{namespace}/{name}": role for namespace, name, _ in mine}
            for first in range(0, len(mine), CHUNK):
                role.ask("begin", robots=mine[first : first + CHUNK])
        self._until_driven()
        one.built = time.monotonic() - begun
        self._calm()
        for role in self._monitors:
            role.ask("settle")

    def _rest(self, one: Found, operator: Operator) -> None:
        self.say(f"{one.robots} robots: at rest for {self._options.rest:g} s")
        before, measure = self._cluster.counted(), operator.measure()
        time.sleep(self._options.rest)
        one.rest = measure.end()
        one.resync = self._own(operator).total(RESYNC)
        now = self._cluster.counted()
        one.rest_counted = now.since(before)
        one.rest_writes = _all_writes(one.rest_counted)
        one.watches = now.total(counting.WATCHES, verb="WATCH")
        one.server_memory = now.total(counting.MEMORY) / 1e6
        self.say(
            f"operator {one.rest.milli:.0f} milli-CPU, {max(one.rest.memory):.0f} MB; "
            f"writes: {one.rest_writes or 'none'}; {one.watches:.0f} watches"
        )

    def _burst(self, one: Found) -> None:
        count = min(self._options.burst, len(self._robots))
        self.say(f"{one.robots} robots: {count} fail at once")
        before, at = self._cluster.counted(), time.time() + 1.0
        told = self._have_failed([(at, robot) for robot in self._random.sample(self._robots, count)])
        one.recoveries, one.burst = self._judged(one, told), count
        self._calm()
        counted = self._cluster.counted().since(before)
        one.burst_writes = _writes_of_each(counted, count)
        self.say(
            f"all recovered after {max(one.recoveries, default=0):.2f} s; writes per failover: "
            + "; ".join(f"{who}: {_told(kinds)}" for who, kinds in one.burst_writes.items())
        )

    def _fail(self, one: Found, operator: Operator) -> None:
        rate, length = self._options.failures, self._options.failing
        times = poisson(rate, length, self._random) or [0.0]
        self.say(f"{one.robots} robots: {len(times)} failures in {length:g} s, independently of each other")
        start = time.time() + 1.0
        who = spread(self._robots, len(times), self._random)
        before, measure = self._cluster.counted(), operator.measure()
        told = self._have_failed([(start + at, robot) for at, robot in zip(times, who, strict=True)])
        one.loaded = measure.end()
        one.failed = self._judged(one, told)
        self._calm()
        counted = self._cluster.counted().since(before)
        one.writes = _writes_of_each(counted, len(times))
        one.reads = counting.requests(counted, "monitor", "reads") / len(times)
        one.events = counted.total(counting.EVENTS) / len(times)
        one.bytes = counted.total(counting.BYTES) / 1e6 / len(times)
        middle = f"p50 {quantile(one.failed, 0.5):.2f} s, " if one.failed else ""
        self.say(
            f"{middle}operator {one.loaded.milli:.0f} milli-CPU; writes per failover: "
            + "; ".join(f"{who}: {_told(kinds)}" for who, kinds in one.writes.items())
        )

    def _claim(self, one: Found, operator: Operator) -> None:
        times = poisson(self._options.rate, self._options.seconds, self._random)[: int(CLAIMED * self._pods)]
        self.say(f"{one.robots} robots: {len(times)} claims, {self._options.rate:g} a second for {times[-1]:.1f} s")
        who = self._fairly(len(times))
        before = {pod["metadata"]["uid"] for pod in self._cluster.claimed()}
        self._cluster.collect()
        used, counted = self._used(operator), self._cluster.counted()
        start = time.time() + 1.0
        self._ask("claim", "claims", [(start + at, robot) for at, robot in zip(times, who, strict=True)])
        told = self._await("claimed", len(times), 120.0)
        one.claiming = {name: (now - used[name]) / len(times) for name, now in self._used(operator).items()}
        counted = self._cluster.counted().since(counted)
        one.claiming["API server"] = counted.total(counting.CPU) / len(times)
        one.claim_reads = counting.requests(counted, "monitor", "reads") / len(times)
        one.claim_events = counted.total(counting.EVENTS) / len(times)
        one.claim_writes = _writes_of_each(counted, len(times))
        one.claim_collections = counted.total(counting.COLLECTIONS)
        pods = [pod for pod in self._cluster.claimed() if pod["metadata"]["uid"] not in before]
        acknowledged = [t for t in told if t["uid"]]
        one.claims = [1000 * (t["done"] - t["intended"]) for t in acknowledged]
        one.retried = sum(t["lost"] for t in told) / max(1, len(told))
        one.double, one.lost = exclusive([(t["uid"], t["claim"]) for t in acknowledged], pods)
        one.lost += len(times) - len(acknowledged)
        for problem in {t["error"] for t in told if t["error"]}:
            self.say(f"a claim failed: {problem}")
        begun = time.monotonic()
        self._cluster.delete(pods)
        self._until(lambda: self._cluster.built()[1] == self._pods, "the pools to be full again")
        one.refilled = time.monotonic() - begun
        self._calm()
        if one.claims:
            self.say(
                f"p50 {quantile(one.claims, 0.5):.0f} ms, p99 {quantile(one.claims, 0.99):.0f} ms, {one.retried:.2f} "
                f"lost races per claim, {one.double} double, {one.lost} lost; pools full after {one.refilled:.0f} s"
            )
            shares = ", ".join(f"{name} {1000 * used:.0f}" for name, used in one.claiming.items())
            self.say(
                f"ms of a processor per claim: {shares}; {one.claim_events:.0f} events of watches; "
                f"{one.claim_collections:.0f} collections of the API server's garbage"
            )
            self.say(
                "writes per claim: " + "; ".join(f"{who}: {_told(kinds)}" for who, kinds in one.claim_writes.items())
            )

    def _restart(self, one: Found) -> None:
        self.say(f"{one.robots} robots: starting the operator again")
        before, begun = self._cluster.counted(), time.monotonic()
        with self._operator() as operator:
            self._until(lambda: operator.idle, "the operator to have looked at everything", every=0.2)
            one.start = time.monotonic() - begun
            time.sleep(CALM)
            counted = self._cluster.counted().since(before)
            one.start_writes, one.dry_runs = counting.writes(counted, "operator"), counting.dry_runs(counted)
            one.start_memory = max(operator.samples, default=operator.memory())
        self.say(f"{one.start:.1f} s, {one.start_memory:.0f} MB, writes: {one.start_writes or 'none'}")

    # -- robots -----------------------------------------------------------------------------------------------------

    def _fairly(self, count: int) -> list[Robot]:
        """Choose robots, no more of a fleet than its pool has pods for, and each as rarely as possible."""
        left = dict.fromkeys((robot.namespace for robot in self._robots), round(CLAIMED * self._options.pool))
        found = []
        for robot in spread(self._robots, 10 * count + len(self._robots), self._random):
            if len(found) < count and left[robot.namespace] > 0:
                left[robot.namespace] -= 1
                found.append(robot)
        return found

    def _have_failed(self, failures: Sequence[tuple[float, Robot]]) -> list[dict[str, object]]:
        self._ask("fail", "failures", failures)
        last = max(at for at, _ in failures) - time.time()
        return self._await("recovered", len(failures), last + 120.0)

    def _ask(self, what: str, key: str, due: Sequence[tuple[float, Robot]]) -> None:
        for role in self._monitors:
            mine = [(at, robot.key) for at, robot in due if self._where[robot.key] is role]
            role.ask(what, **{key: mine})

    def _await(self, what: str, count: int, within: float) -> list[dict[str, object]]:
        """Return this many reports of a kind from the monitors, or fewer after ``within`` seconds."""
        found: list[dict[str, object]] = []
        end = time.monotonic() + within
        while len(found) < count and time.monotonic() < end:
            time.sleep(0.5)  # the bench runs on the processors that it measures
            for role in self._monitors:
                for told in role.told_so_far():
                    if told["told"] == what:
                        found.append(told)
                    elif told["told"] == "broken":
                        self.say(f"a monitor ended: {told['error']}")
        if len(found) < count:
            self.say(f"of {count} only {len(found)} {what} within {within:.0f} s")
        return found

    def _judged(self, one: Found, told: Sequence[dict[str, object]]) -> list[float]:
        """Return the seconds from each failure until the robot was driven again, and note recoveries that did not use
        the pool."""
        found = []
        for t in told:
            moments = t["moments"]
            assert isinstance(moments, dict)
            if t["result"] == "Recovered":
                found.append(float(moments["verified"]) - float(str(t["intended"])))
            if t["strategy"] != "Fallback/Uninitialized":
                one.others.append(f"{t['robot']}: {t['result']} by {t['strategy'] or 'nothing'}: {t['attempts']}")
        one.unrecovered += len([t for t in told if t["result"] != "Recovered"])
        return found

    # -- waiting ----------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _operator(self) -> Iterator[Operator]:
        with Operator(self._operator_config, self._log) as operator:
            yield operator

    def _used(self, operator: Operator) -> dict[str, float]:
        """Return the seconds of processor time so far of the processes that the API server's metrics do not cover."""
        return {"monitors": sum(role.cpu() for role in self._monitors), "operator": operator.cpu()}

    def _own(self, operator: Operator) -> Own:
        return operator.metrics() or Own({})

    def _until(self, condition: Callable[[], object], what: str, *, every: float = 2.0) -> None:
        begun = said = time.monotonic()
        while not condition():
            now = time.monotonic()
            if now - begun > SETTLED:
                log = self._log.read_text(errors="replace")[-3000:]
                raise SystemExit(f"waited {SETTLED:g} s for {what}; the operator's log ends with\n{log}")
            if now - said > 30:
                said = now
                self.say(f"waiting for {what}: (built, pods of pools) {self._cluster.built()}")
            time.sleep(every)

    def _until_driven(self) -> None:
        def driven() -> bool:
            ended = [
                told["error"] for role in self._monitors for told in role.told_so_far() if told["told"] == "broken"
            ]
            if ended:
                raise SystemExit(f"{len(ended)} monitors ended; the first with: {ended[0]}")
            return sum(role.ask("state")["driven"] for role in self._monitors) == len(self._robots)

        self._until(driven, "every robot to be driven")

    def _calm(self) -> None:
        """Wait until everything is healthy and nobody but the lease's holder writes anything."""
        self._until_driven()
        self._until(lambda: self._cluster.built() == (len(self._robots), self._pods), "the pools to be full")
        begun, before = time.monotonic(), self._cluster.counted()
        while time.monotonic() - begun < SETTLED:
            time.sleep(CALM)
            now = self._cluster.counted()
            if not _all_writes(now.since(before)):
                return
            before = now
        self.say(f"something is still written after {SETTLED:g} s")

    def say(self, text: str) -> None:
        """Print a line of progress."""
        print(f"[{time.monotonic() - self._begun:6.0f} s] {text}", flush=True)


WHO = ("monitor", "operator")


def _all_writes(counted: Reading) -> dict[str, float]:
    """Return the writes of operator and monitors."""
    return {f"{who}: {what}": n for who in WHO for what, n in counting.writes(counted, who).items()}


def _writes_of_each(counted: Reading, failovers: int) -> dict[str, dict[str, float]]:
    """Return the writes per failover, by account and kind."""
    return {who: {what: n / failovers for what, n in counting.writes(counted, who).items()} for who in WHO}


def exclusive(acknowledged: Sequence[tuple[str, str]], pods: Sequence[cluster.Object]) -> tuple[int, int]:
    """Return how many claims were made twice, and how many were lost, by what was acknowledged (UID of the pod, claim)
    and the present state.

    Twice: two claims were acknowledged for one pod, or one claim is on two pods. Lost: a claim was acknowledged but is
    not on its pod, or a claim on a pod was never acknowledged.
    """
    has = {pod["metadata"]["uid"]: pod["metadata"]["annotations"][cluster.names.CLAIM] for pod in pods}
    uids, claims = [uid for uid, _ in acknowledged], list(has.values())
    double = len(uids) - len(set(uids)) + len(claims) - len(set(claims))
    told = dict(acknowledged)
    lost = sum(has.get(uid) != claim for uid, claim in told.items()) + len(has.keys() - told.keys())
    return double, lost


def _told(kinds: dict[str, float]) -> str:
    return ", ".join(f"{what} {n:.2f}" for what, n in kinds.items()) or "none"


# -- what was found ------------------------------------------------------------------------------------------------------


def told(found: Sequence[Found], options: argparse.Namespace) -> Report:
    """Return the report on all sizes; the bounds apply to the largest."""
    report = Report("scale-rest" if options.only_rest else "scale")
    for one in found:
        _tell_one(report, one, options, last=one is found[-1])
    for one in found:
        for how, found_writes in (("", one.writes), (" of a burst", one.burst_writes)):
            for who, kinds in found_writes.items():
                report.note(f"writes per failover{how} of the {who}, {one.robots} robots", _told(kinds))
        for name, kinds in (("at rest", one.rest_writes), ("at the operator's start", one.start_writes)):
            report.note(f"writes {name}, {one.robots} robots", _told(kinds))
        for text in one.others[:5]:
            report.note(f"not by the pool, {one.robots} robots", text)
    if len(found) > 1:
        for name, values in grown(found).items():
            sizes = list(values)
            power = exponent(sizes, list(values.values()))
            least, most = extrapolated(sizes, list(values.values()), LARGE)
            grows = f"grows with the power {power:.2f} of the number" if power is not None else "was 0 at some size"
            report.note(f"growth of {name}", f"{grows}; for {LARGE} robots {least:.4g} to {most:.4g}")
    report.note("fleets", f"of {options.fleet} robots, each with a namespace and a pool of {options.pool} pods")
    report.note("priority", priority())
    return report


def _tell_one(report: Report, one: Found, options: argparse.Namespace, *, last: bool) -> None:
    def figure(name: str, values: Sequence[float], unit: str, must: dict[str, float] | None = None) -> None:
        report.figure(f"{name}, {one.robots} robots", values, unit=unit, must=must if last else None)

    assert one.rest is not None
    assert one.rest_counted is not None
    minutes = one.rest.seconds / 60
    figure("operator at rest, CPU", [one.rest.milli], "milli-CPU", {"max": CPU_MOST})
    figure("operator at rest, memory", one.rest.memory, "MB", {"max": MEMORY_MOST})
    figure(
        "writes of a healthy workload", [sum(one.rest_writes.values()) / one.robots / minutes], "a minute", {"max": 0}
    )
    figure("operator's list of everything", [one.resync], "s", {"max": RESYNC_MOST})
    figure("watches", [one.watches], "")
    figure("watch traffic at rest", [one.rest_counted.total(counting.BYTES) / 1e6 / minutes], "MB a minute")
    figure("API server's memory at rest", [one.server_memory], "MB")
    figure("API server's CPU at rest", [1000 * one.rest_counted.total(counting.CPU) / one.rest.seconds], "milli-CPU")
    figure("operator's start until all was looked at", [one.start], "s", {"max": START_MOST})
    figure("operator's memory at its start", [one.start_memory], "MB", {"max": MEMORY_MOST})
    figure("writes at its start", [sum(one.start_writes.values())], "", {"max": 0})
    figure("dry runs at its start", [one.dry_runs], "")
    figure("changes that only a list brought", [one.missed], "")
    figure("built and driven, those that came last", [one.built], "s")
    if one.loaded is None:
        return
    if one.recoveries:
        figure(f"{one.burst} failures at once, each recovered", one.recoveries, "s")
        figure(f"{one.burst} failures at once, all recovered", [max(one.recoveries)], "s")
    for who in WHO:
        figure(f"writes per failover of a burst, {who}", [sum(one.burst_writes[who].values())], "")
    if one.failed:
        by_monitor, by_operator = (sum(one.writes[who].values()) for who in WHO)
        figure("writes per failover, monitor", [by_monitor], "", {"max": WRITES_MOST})
        figure("writes per failover, operator", [by_operator], "")
        figure("reads per failover, monitor", [one.reads], "")
        figure("watch events per failover", [one.events], "")
        figure("watch traffic per failover", [one.bytes], "MB")
        figure(f"{options.failures:g} failures/s, each recovered", one.failed, "s")
    figure(f"operator with {options.failures:g} failures/s, CPU", [one.loaded.milli], "milli-CPU")
    figure(f"operator with {options.failures:g} failures/s, memory", one.loaded.memory, "MB")
    figure("failures that nothing recovered", [one.unrecovered], "", {"max": 0})
    if one.claims:
        figure(f"claims at {options.rate:g}/s", one.claims, "ms")
        figure(f"claims at {options.rate:g}/s, p99", [quantile(one.claims, 0.99)], "ms", {"max": CLAIM_P99})
    figure("claims made twice", [one.double], "", {"max": 0})
    figure("claims lost", [one.lost], "", {"max": 0})
    figure("races lost per claim", [one.retried], "")
    for name, used in one.claiming.items():
        figure(f"CPU per claim, {name}", [1000 * used], "ms")
    figure("reads per claim, monitor", [one.claim_reads], "")
    figure("watch events per claim", [one.claim_events], "")
    figure("collections of the API server's garbage during claims", [one.claim_collections], "")
    figure("pools full again after the claims", [one.refilled], "s")
    figure("operator ended by itself", [one.restarts], "")


def grown(found: Sequence[Found]) -> dict[str, dict[int, float]]:
    """Return the figures whose growth is evaluated: by name and number of robots."""
    values: dict[str, dict[int, float]] = {}
    for one in found:
        assert one.rest is not None
        assert one.rest_counted is not None
        minutes = one.rest.seconds / 60
        for name, value in (
            ("operator's CPU at rest (milli-CPU)", one.rest.milli),
            ("operator's memory at rest (MB)", max(one.rest.memory)),
            ("operator's start (s)", one.start),
            ("watches", one.watches),
            ("watch traffic at rest (MB a minute)", one.rest_counted.total(counting.BYTES) / 1e6 / minutes),
            ("watch events per failover", one.events),
            ("time until all of a burst recovered (s)", max(one.recoveries, default=0.0)),
            ("API server's memory (MB)", one.server_memory),
        ):
            values.setdefault(name, {})[one.robots] = value
    return values


def draw(found: Sequence[Found], options: argparse.Namespace) -> None:
    """Draw the pictures."""
    folder: Path = options.pictures
    folder.mkdir(parents=True, exist_ok=True)
    title = f"Claims at {options.rate:g}/s"
    claims = {one.robots: one.claims for one in found if one.claims}
    pictures.latencies(claims, CLAIM_P99, folder / "scale-claims.png", title=title)
    bursts = {one.robots: one.recoveries for one in found if one.recoveries}
    pictures.recoveries(bursts, folder / "scale-burst.png", title=f"{found[-1].burst} failures at once")
    if len(found) > 1:
        pictures.growth(grown(found), folder / "scale-growth.png", title="Growth with the number of robots")


def sizes(robots: int, fleet: int) -> list[int]:
    """Return a tenth, three tenths and all of the robots, in whole fleets."""
    smaller = {max(1, round(share * robots / fleet)) * fleet for share in (0.1, 0.3)}
    return sorted({size for size in smaller if size < robots} | {robots})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--pool", type=int, default=100, help="pods of each fleet's shared pool")
    parser.add_argument("--fleet", type=int, default=100, help="robots that share a namespace and a pool")
    parser.add_argument("--rate", type=float, default=100.0, help="claims per second")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the claims, as long as there are pods")
    parser.add_argument("--burst", type=int, default=100, help="number of failures at once")
    parser.add_argument("--failures", type=float, default=2.0, help="independent failures per second")
    parser.add_argument("--failing", type=float, default=30.0, metavar="SECONDS", help="duration of these failures")
    parser.add_argument(
        "--rest",
        type=float,
        default=120.0,
        metavar="SECONDS",
        help="time at rest, long enough for some of the operator's lists",
    )
    parser.add_argument(
        "--only-rest", action="store_true", help="measure only the fleet at rest and the start, without failures"
    )
    parser.add_argument(
        "--sizes",
        type=lambda text: [int(size) for size in text.split(",")],
        help="numbers of robots, such as 100,300,1000",
    )
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count(), help="number of processes that the monitors share"
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="draw scale-claims.png, -burst.png, -growth.png"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed that determines which robot fails when")
    parser.add_argument("--keep", action="store_true", help="leave the cluster running")
    parser.add_argument("--role", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        from bench.scaling import monitors

        monitors.main(os.environ[NODES])
        return
    options.fleet = min(options.fleet, options.robots)
    options.sizes = options.sizes or sizes(options.robots, options.fleet)
    with cluster.running(keep=options.keep) as made, contextlib.ExitStack() as stack:
        roles = []
        for number in range(options.processes):
            role = Role("bench.scale", f"monitors-{number}", **{NODES: str(made.kubeconfig)})
            stack.callback(role.end)
            role.told(120)
            roles.append(role)
        for found in Bench(options, made, roles).run():
            report = told(found, options)
            written = report.write()  # a run that is interrupted keeps its results so far
    print(report.table())
    print(written)
    if options.pictures:
        draw(found, options)
    sys.exit(0 if report.held else 1)


if __name__ == "__main__":
    main()
