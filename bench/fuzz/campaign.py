"""Sends generated objects through an API server to a running operator and a running monitor, while other workloads fail."""

from __future__ import annotations

import json
import multiprocessing
import os
import queue
import tempfile
import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from bench.fuzz import victims
from bench.fuzz.samples import Sample, sample
from bench.fuzz.sending import Api, Sender, Sent, refusing_pods, verdict
from bench.fuzz.victims import Failures, Live, Victims, protected_in
from bench.fuzz.watching import Found, Processes, Turn, lease_transitions
from bench.results import Report
from tests.e2e.conftest import install
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, manifest
from understudy.api.base import API_VERSION

BATCH = 200
"""Objects after which an object of the bench's own is judged, as a sign of life."""

CHANGES = 20
"""Changes of the live workload after which its own objects are put back."""

AHEAD = 100
"""Objects that are drawn before they are sent."""

CAUSE_SECONDS = 5.0
"""An object that was sent so long before a long turn may be its cause."""

FRESH_EVERY = 240.0
"""Seconds between two small workloads that are created."""


@dataclass
class Options:
    """Options of a run."""

    seed: int
    objects: int
    only: list[int]
    alive: int
    before: int
    """Failures of each robot without any generated object, as a baseline."""
    minutes: float
    """Time after which no more objects are sent."""
    keep: bool = False


@dataclass
class Run:
    """What happened in a run."""

    sent: list[Sent] = field(default_factory=list)
    signs: list[float] = field(default_factory=list)
    """Seconds to the verdict about the bench's own objects."""
    live: list[tuple[float, Sample, int]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    fresh: list[float] = field(default_factory=list)


def seeds(options: Options) -> range | list[int]:
    """Return the seeds of a run's objects."""
    return options.only or range(options.seed, options.seed + options.objects)


def drawn(numbers: range | list[int]) -> Iterator[Sample]:
    """Yield the objects of seeds in order, which another process draws ahead."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        waiting: queue.SimpleQueue[Future[Sample]] = queue.SimpleQueue()
        rest = iter(numbers)
        for number in [number for _, number in zip(range(AHEAD), rest, strict=False)]:
            waiting.put(pool.submit(sample, number))
        while not waiting.empty():
            found = waiting.get().result()
            if (number := next(rest, None)) is not None:
                waiting.put(pool.submit(sample, number))
            yield found


class Campaign:
    """One run on a cluster."""

    def __init__(self, kubeconfig: Path, options: Options) -> None:
        self._options, self._api, self.run_ = options, Api(kubeconfig), Run()
        name = f"fuzz-{uuid.uuid4().hex[:6]}"
        self._system = install(kubeconfig)
        self._near, self._far = Kubectl(kubeconfig, name), Kubectl(kubeconfig, f"{name}-apart")
        self._sender = Sender(self._api, name)
        self._live = Live(self._api, self._sender, self._near)
        self.baseline: dict[str, Failures] = {}
        self.during: dict[str, Failures] = {}
        self.fresh_before: list[float] = []
        self.lease_moved = 0
        self._ended = threading.Event()
        self.found = Found()

    def carry_out(self) -> None:
        """Set up, measure without generated objects, send them all, and clean up."""
        spaces = (self._near, self._far)
        try:
            for space in spaces:
                space("create", "namespace", space.namespace)
                # Generated templates have no security contexts, and should reach the operator.
                space("label", "namespace", space.namespace, "pod-security.kubernetes.io/enforce=baseline")
            self._set_up()
            self._measure()
        finally:
            if not self._options.keep:
                for item in refusing_pods(self._near.namespace, self._near.namespace):
                    self._system("delete", item["kind"], item["metadata"]["name"], "--ignore-not-found")
                for space in spaces:
                    space("delete", "namespace", space.namespace, "--wait=false")

    def _set_up(self) -> None:
        self._system.apply(refusing_pods(self._near.namespace, self._near.namespace))
        self._robots = {}
        for name, space in (("same namespace", self._near), ("another namespace", self._far)):
            robot = Robot(space)
            space.apply(victims.protection())
            space.apply(robot.objects(policy="quickstart-executing"))
            self._robots[name] = robot
        for robot in self._robots.values():
            robot.wait_protected(within=240)
        self._live.set_up()
        self._sender.put_slots(victims.originals())

    def _measure(self) -> None:
        for name, robot in self._robots.items():
            found = self.baseline[name] = Failures()
            for _ in range(self._options.before):
                victims.fail(robot, found)
        self.fresh_before.append(protected_in(self._far, "robot-5"))
        say(f"baseline: {self.baseline}, fresh {self.fresh_before}")
        places = [
            ("operator", self._system, "app.kubernetes.io/name=understudy"),
            ("monitors of others", self._far, "understudy.dev/component=monitor"),
            (
                "monitor in the same namespace",
                self._near,
                f"understudy.dev/monitored={self._robots['same namespace'].workload}",
            ),
            ("monitor with generated content", self._near, f"understudy.dev/monitored={self._live.robot.workload}"),
        ]
        with tempfile.TemporaryDirectory() as folder:
            before = lease_transitions(self._api, self._system.namespace)
            processes, failing = Processes(self._api, places, Path(folder)), Victims(self._robots)
            processes.look()
            processes.start()
            failing.start()
            fresh, ended = threading.Thread(target=self._fresh, daemon=True), self._ended
            fresh.start()
            try:
                self._send()
            finally:
                ended.set()
                failing.stop()
                fresh.join(timeout=200)
                self.during = failing.found
                self.lease_moved = lease_transitions(self._api, self._system.namespace) - before
                self.found = processes.stop()

    def _fresh(self) -> None:
        while not self._ended.wait(FRESH_EVERY / 4 if not self.run_.fresh else FRESH_EVERY):
            try:
                self.run_.fresh.append(protected_in(self._far, "robot-5"))
            except AssertionError as error:
                self.run_.findings.append(f"a small workload was not protected: {str(error)[:300]}")

    # -- sending ----------------------------------------------------------------------------------------------------------

    def _send(self) -> None:
        places = threading.BoundedSemaphore(self._options.alive)
        changes: queue.Queue[Sample | None] = queue.Queue(maxsize=50)
        live = threading.Thread(target=self._change, args=(changes,), daemon=True)
        live.start()
        with ThreadPoolExecutor(self._options.alive) as pool:

            def one(found: Sample) -> None:
                try:
                    sent = self._sender.send(found)
                    self.run_.sent.append(sent)
                    if sent.late:
                        self._note(f"{found}: no verdict within its time")
                    if sent.status == 0 or sent.status >= 500:
                        self._note(f"{found}: the API server answered {sent.status}", finding=False)
                except Exception as error:
                    self._note(f"{found}: the bench failed: {error!r:.300}")
                finally:
                    places.release()

            begun = time.monotonic()
            for number, found in enumerate(drawn(seeds(self._options))):
                if found.way == "live":
                    changes.put(found)
                else:
                    places.acquire()
                    pool.submit(one, found)
                if number % BATCH == BATCH - 1:
                    self._sign_of_life(number)
                    if time.monotonic() - begun > 60 * self._options.minutes:
                        break
                    say(
                        f"{number + 1} objects in {time.monotonic() - begun:.0f} s; {len(self.run_.live)} changes of the live workload"
                    )
        changes.put(None)
        live.join(timeout=600)

    def _sign_of_life(self, number: int) -> None:
        """Have an object of the bench's own judged, behind the others."""
        [policy] = [item for item in manifest("strategies/restart.yaml") if item["kind"] == "FailurePolicy"]
        item = {**policy, "apiVersion": API_VERSION, "metadata": {"name": f"sign-of-life-{number}"}}
        path, begun = self._sender.path("FailurePolicy"), time.monotonic()
        self._api.send("POST", path, json.dumps(item))
        name = f"{path}/{item['metadata']['name']}"
        while not (found := verdict(self._api.get(name))) and time.monotonic() - begun < 60:
            time.sleep(0.1)
        self.run_.signs.append(time.monotonic() - begun)
        if not found.startswith("True"):
            self._note(f"after object {number}: the verdict about a valid policy was {found!r}")
        self._api.send("DELETE", name)

    def _change(self, changes: queue.Queue[Sample | None]) -> None:
        while (found := changes.get()) is not None:
            at, status = time.time(), 0
            try:
                status = self._live.change(found)
            except Exception as error:
                self._note(f"{found}: the bench failed: {error!r:.300}")
            self.run_.live.append((at, found, status))
            time.sleep(0.2)
            if self._live.changes % CHANGES == 0:
                self._restore()
        self._restore()

    def _restore(self) -> None:
        if problem := self._live.restore():
            last = ", ".join(str(found.seed) for _, found, _ in self.run_.live[-CHANGES:])
            self._note(f"{problem}; the last changes were of the seeds {last}")

    def _note(self, text: str, *, finding: bool = True) -> None:
        say(text)
        if finding:
            self.run_.findings.append(text)

    # -- results ----------------------------------------------------------------------------------------------------------

    def suspects(self, turn: Turn) -> list[int]:
        """Return the seeds of objects that may be the cause of a long turn, the largest first."""
        sent = [(one.at, one.sample) for one in self.run_.sent if one.stored]
        if "robot-9" in turn.process:
            sent = [(at, found) for at, found, status in self.run_.live if 200 <= status < 300]
        near = [found for at, found in sent if turn.at - CAUSE_SECONDS <= at <= turn.at]
        return [found.seed for found in sorted(near, key=lambda found: -len(found.text))][:5]


def say(text: str) -> None:
    """Print a line at once."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def run(options: Options) -> int:
    """Carry out a campaign, and write its report. Returns the exit status."""
    campaign = Campaign(Path(os.environ["KUBECONFIG"]), options)
    campaign.carry_out()
    report = told(campaign, options)
    print(report.table())
    for finding in campaign.run_.findings:
        print(f"finding: {finding}")
    print(report.write())
    return 0 if report.held and not campaign.run_.findings else 1


def told(campaign: Campaign, options: Options) -> Report:
    """Return the report of a campaign. Findings are added to those of the run."""
    found, happened, report = campaign.found, campaign.run_, Report("fuzz")
    happened.findings += [f"traceback: {one}" for one in found.tracebacks]
    own = [turn for turn in found.turns if turn.processor > 0.1]
    happened.findings += [
        f"{turn.process} was busy for {turn.elapsed:.2f} s ({turn.processor:.2f} s processor, {turn.collected:.2f} s of it garbage "
        f"collection); sent just before: {campaign.suspects(turn)}"
        for turn in own
    ]
    judged = [one for one in happened.sent if one.seconds is not None]
    stored = sum(one.stored for one in happened.sent)
    report.figure("time to a verdict", [one.seconds or 0.0 for one in judged] or [0.0], unit="s", must={"max": 60})
    report.figure("time to a verdict of a plain policy", happened.signs or [0.0], unit="s", must={"max": 60})
    report.figure("workload with generated content: protected again", campaign._live.restored or [0.0], unit="s")
    for name, failures in campaign.during.items():
        for what, values, before in (
            ("recovery", failures.recovery, campaign.baseline[name].recovery),
            ("gap without commands", failures.gap, campaign.baseline[name].gap),
        ):
            report.figure(f"robot in {name}: {what}", [1000 * v for v in values] or [0.0], unit="ms")
            report.baseline(
                f"robot in {name}: {what}",
                [1000 * v for v in before] or [0.0],
                unit="ms",
                of="without generated objects",
            )
        report.figure(
            f"robot in {name}: not protected without a failure",
            [float(len(failures.unprotected))],
            unit="s",
            must={"max": 0},
        )
        happened.findings += failures.problems
    report.figure("small workload: until protected", happened.fresh or [0.0], unit="s")
    report.baseline("small workload: until protected", campaign.fresh_before, unit="s", of="without generated objects")
    report.figure("turns above 100 ms of processor time", [float(len(own))], unit="turns", must={"max": 0})
    report.figure("restarts of operator and monitors", [float(found.restarts)], unit="restarts", must={"max": 0})
    report.figure("tracebacks", [float(len(found.tracebacks))], unit="", must={"max": 0})
    report.figure("changes of the lease's holder", [float(campaign.lease_moved)], unit="", must={"max": 0})
    answers, verdicts = Counter(one.status for one in happened.sent), Counter(one.verdict for one in judged)
    report.note("failure", f"application killed, timeout {victims.GAP}")
    known = [one.sample.seed for one in happened.sent] + [one.seed for _, one, _ in happened.live]
    report.note("seeds", f"{options.only or f'{min(known)} to {max(known)}'}")
    report.note(
        "objects", f"{len(happened.sent) + len(happened.live)}, of which {stored} were stored; answers: {dict(answers)}"
    )
    live = Counter(200 <= status < 300 for _, _, status in happened.live)
    report.note("live workload", f"{live[True]} changes were stored, {live[False]} refused by the API server")
    report.note("verdicts", ", ".join(f"{name} {count}" for name, count in verdicts.most_common()))
    for kind, counts in found.busy.items():
        report.note(f"long turns, {kind}", ", ".join(f">{key}: {count:g}" for key, count in counts.items()))
    report.note("findings", " | ".join(happened.findings) or "none")
    return report
