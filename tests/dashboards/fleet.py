"""The past of a fleet as a Prometheus would have scraped it, made up for pictures: ten mobile robots and two arms.

Times of recoveries are those that the benches found on the project's machine; how often robots fail is not from anywhere. Half an hour
before the end a node is lost, with the applications of three robots and two of the three pods of a shared pool, so that one robot waits
for a minute.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from tests.e2e.past import every, histogram

HOUR = 3600.0
LENGTH = 2.2 * HOUR
"""Of that past: an hour is drawn, of which each moment asks for the hour before."""
SCRAPED = 15
"""Seconds between two scrapes."""

TIMES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, math.inf)
WRITES = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5, math.inf)

EXECUTING, UNINITIALIZED, RESTART = "Fallback/Executing", "Fallback/Uninitialized", "Restart"
PARTS = {
    EXECUTING: {"detection": 0.502, "cluster": 0.0072, "startup": 0.0, "reinitialization": 0.0},
    UNINITIALIZED: {"detection": 0.502, "cluster": 0.024, "startup": 1.211, "reinitialization": 0.076},
    RESTART: {"detection": 0.502, "cluster": 1.203, "startup": 0.552, "reinitialization": 0.645},
}
NODE_LOST = -30 * 60.0
"""When that was, from the end."""
DRY = 60.0
"""How long the pool has no pod then."""


@dataclass(frozen=True)
class Failure:
    """One of a robot's application."""

    at: float
    strategy: str
    parts: Mapping[str, float]
    result: str = "Recovered"
    waited: float = 0.0
    """For a pod of the pool, which is of the cluster's part."""

    @property
    def seconds(self) -> float:
        """Until it was driven again."""
        return sum(self.parts.values())

    @property
    def over(self) -> float:
        """When that was."""
        return self.at + self.seconds


class Spell(NamedTuple):
    """An interval in which a state holds, and for conditions their reason then."""

    begin: float
    end: float
    reason: str = ""

    def holds(self, now: float) -> bool:
        """Whether it is so at a moment."""
        return self.begin <= now < self.end


@dataclass(frozen=True)
class Robot:
    """What drives one robot, and its monitor's pod."""

    name: str
    number: int
    begun: float
    topics: Mapping[str, float]
    """How many messages a second, of those that are watched."""
    failures: Sequence[Failure]
    kept: Sequence[str] = ()
    namespace: str = "warehouse"
    degraded: Sequence[Spell] = ()
    unprotected: Sequence[Spell] = ()
    starved: Sequence[Spell] = ()

    def health(self, now: float) -> str:
        """Its state as the operator tells it."""
        for failure in self.failures:
            if failure.at + 0.5 <= now < failure.over:
                return "Recovering"
            if failure.result == "Failed" and failure.over <= now < failure.over + 240:
                return "Failed"
        return "Degraded" if any(spell.holds(now) for spell in self.degraded) else "Healthy"

    def told(self, now: float) -> Iterator[str]:
        """What its monitor tells at a moment."""
        pod = f"{self.name}-monitor"
        mine = (
            f'container="monitor",endpoint="metrics",instance="10.244.1.{self.number}:9108",job="understudy-system/understudy-monitors",'
            f'namespace="{self.namespace}",pod="{pod}",workload="{self.name}"'
        )
        past = [failure for failure in self.failures if failure.over <= now]
        yield from self._process(mine, now)
        yield from _recoveries(mine, past)
        yield f"understudy_gate_epoch{{{mine}}} {3 + 2 * len(past)}"
        for topic, rate in self.topics.items():
            labels = f'{mine},topic="{topic}"'
            yield f"understudy_topic_messages_total{{{labels}}} {self._received(topic, rate, now):.0f}"
            yield f"understudy_topic_longest_gap_seconds{{{labels}}} {self._gap(topic, rate, now):.4f}"
        for name in self.kept:
            since = max((f.at for f in self.failures if f.at <= now < f.over), default=now)
            yield f'understudy_kept_bytes{{{mine},name="{name}"}} {7919 * len(name)}'
            yield f'understudy_kept_timestamp_seconds{{{mine},name="{name}"}} {since - 0.2 - (now * 0.37 + len(name)) % 0.8:.3f}'
        spent = sum(failure.over > now - HOUR for failure in past)
        yield f'understudy_budget_left{{{mine},within="1h"}} {8 - spent}'
        yield f"understudy_degradations_total{{{mine}}} {sum(spell.begin <= now for spell in self.degraded)}"
        if waited := sum(failure.waited > 0 for failure in past):
            yield f'understudy_recoveries_held_total{{{mine},why="Storm"}} {waited}'
        yield from self._requests(mine, now, past)

    def _process(self, mine: str, now: float) -> Iterator[str]:
        alive = now - self.begun
        late = sum(min(now, spell.end) - spell.begin for spell in self.starved if spell.begin <= now)
        yield f"process_start_time_seconds{{{mine}}} {self.begun}"
        yield f"process_cpu_seconds_total{{{mine}}} {0.0151 * alive + 0.3 * math.sin(now / 400 + self.number):.3f}"
        yield f"process_resident_memory_bytes{{{mine}}} {85e6 + 1.5e6 * math.sin(now / 900 + self.number) + 20 * alive:.0f}"
        yield f"understudy_tree_evaluations_total{{{mine}}} {20 * alive - 6 * late:.0f}"
        yield f"understudy_tree_overruns_total{{{mine}}} {0.004 * alive + 1.8 * late:.0f}"

    def _received(self, topic: str, rate: float, now: float) -> float:
        silent = sum(min(now, f.over) - f.at for f in self.failures if f.at <= now) if topic == "/cmd_vel" else 0.0
        slow = sum(min(now, spell.end) - spell.begin for spell in self.degraded if spell.begin <= now)
        return rate * (now - self.begun - silent - (0.14 * slow if topic == "/scan" else 0.0))

    def _gap(self, topic: str, rate: float, now: float) -> float:
        usual = (1.15 + 0.25 * math.sin(now / 7 + len(topic)) ** 2) / rate
        if topic != "/cmd_vel":
            return usual
        return max([usual, *(min(now, f.over) - f.at for f in self.failures if f.at <= now < f.over + 90)])

    def _requests(self, mine: str, now: float, past: Sequence[Failure]) -> Iterator[str]:
        alive, failed = now - self.begun, len(past)
        counts = {
            ("GET", "pods", "200"): alive / 300,
            ("GET", "networkpolicies", "200"): alive / 300,
            ("PATCH", "robotworkloads", "200"): alive / 60 + 6 * failed,
            ("PATCH", "networkpolicies", "200"): 2 * failed,
            ("POST", "events", "201"): 4 * failed,
            ("DELETE", "pods", "200"): failed,
        }
        for (method, resource, code), count in counts.items():
            if count:
                labels = f'{mine},method="{method}",resource="{resource}",code="{code}"'
                yield f"understudy_api_requests_total{{{labels}}} {count:.0f}"
        for place, resource in enumerate(("pods", "networkpolicies", "robotworkloads", "fallbackpools")):
            heard = now - (now + 17 * place + 5 * self.number) % 60
            yield f'understudy_watch_last_event_timestamp_seconds{{{mine},resource="{resource}"}} {heard:.3f}'


def _recoveries(mine: str, past: Sequence[Failure]) -> Iterator[str]:
    for strategy, result in sorted({(f.strategy, f.result) for f in past}):
        found = [f for f in past if (f.strategy, f.result) == (strategy, result)]
        labels = f'{mine},strategy="{strategy}"'
        yield f'understudy_recoveries_total{{{labels},result="{result}"}} {len(found)}'
        if result == "Recovered":
            yield from histogram("understudy_recovery_seconds", labels, [f.seconds for f in found], TIMES)
            for part in PARTS[strategy]:
                times = [f.parts[part] for f in found]
                yield from histogram("understudy_recovery_part_seconds", f'{labels},part="{part}"', times, TIMES)
    commits = [f.parts["cluster"] - f.waited for f in past if f.strategy == EXECUTING]
    commits += [0.008 + f.at % 0.004 for f in past if f.strategy not in (EXECUTING, "none")]
    if commits:
        yield from histogram("understudy_gate_commit_seconds", mine, commits, WRITES)
    claims = [f.parts["cluster"] - f.waited - 0.006 for f in past if f.strategy == UNINITIALIZED]
    if claims:
        yield from histogram("understudy_claim_seconds", f'{mine},result="Won"', claims, WRITES)


@dataclass(frozen=True)
class Operator:
    """The replica that leads."""

    robots: Sequence[Robot]
    end: float

    def told(self, now: float) -> Iterator[str]:
        """What it tells at a moment."""
        mine = (
            'container="operator",endpoint="metrics",instance="10.244.0.9:9108",job="understudy-system/understudy",'
            'pod="understudy-6c7d9f5b8-x2k4q"'
        )
        yield f'understudy_leader{{{mine},namespace="understudy-system"}} 1'
        for robot in self.robots:
            labels = f'{mine},namespace="{robot.namespace}",workload="{robot.name}"'
            past = [f for f in robot.failures if f.over <= now]
            yield f'understudy_workload_health{{{labels},health="{robot.health(now)}"}} 1'
            yield f"understudy_workload_recoveries_total{{{labels}}} {len(past)}"
            if past:
                yield f"understudy_workload_last_recovery_timestamp_seconds{{{labels}}} {past[-1].over:.3f}"
            lacking = next((spell.reason for spell in robot.unprotected if spell.holds(now)), None)
            yield _condition(labels, "Protected", lacking, "FirstStrategyReady")
            blind = "MonitorNotReady" if lacking == "MonitorNotReady" else None
            yield _condition(labels, "Monitored", blind, "AllTopicsWatched")
            for condition, reason in (
                ("Accepted", "Accepted"),
                ("Reconciled", "Reconciled"),
                ("GateEnforced", "Enforced"),
            ):
                yield _condition(labels, condition, None, reason)
        yield from self._pools(mine, now)
        yield from self._itself(f'{mine},namespace="understudy-system"', now)

    def _itself(self, mine: str, now: float) -> Iterator[str]:
        """Its work: little at rest, and more for a while after the node was lost."""
        since = now - self.end - NODE_LOST
        busy = math.exp(-since / 40) if since >= 0 else 0.0
        done = 0.9 * (now - self.end + LENGTH) + (400 * (1 - busy) if since >= 0 else 0.0)
        yield f"understudy_queue_length{{{mine}}} {9 * busy:.0f}"
        for result, share in (("ok", 1.0), ("stale", 0.04)):
            yield f'understudy_reconciliations_total{{{mine},kind="robotworkloads",result="{result}"}} {share * done:.0f}'
        for state in ("waiting", "under_way"):
            yield f'understudy_monitor_rollouts{{{mine},state="{state}"}} 0'
        for method, code, share in (
            ("GET", "200", 0.7),
            ("PATCH", "200", 0.25),
            ("POST", "201", 0.05),
            ("PATCH", "409", 0.004),
        ):
            told = f'{mine},method="{method}",resource="pods",code="{code}"'
            yield f"understudy_api_requests_total{{{told}}} {share * done:.0f}"
        yield f"understudy_last_resync_timestamp_seconds{{{mine}}} {now - now % 31:.3f}"
        for place, resource in enumerate(("pods", "networkpolicies", "deployments")):
            heard = now - (now + 21 * place) % 60
            yield f'understudy_watch_last_event_timestamp_seconds{{{mine},resource="{resource}"}} {heard:.3f}'

    def _pools(self, mine: str, now: float) -> Iterator[str]:
        lost, dry = self.end + NODE_LOST, Spell(self.end + NODE_LOST, self.end + NODE_LOST + DRY)
        hot = 8 if lost <= now < lost + 200 else 10
        spare = 0 if dry.holds(now) else 1 if lost <= now < lost + 150 else 3
        for namespace, pool, wanted, ready, claimed in (
            ("warehouse", "amr-hot", 10, hot, 0),
            ("warehouse", "amr-spare", 3, spare, 1 if now < lost else 3),
            ("lab", "arm-hot", 2, 1 if self.robots[-1].unprotected[0].holds(now) else 2, 0),
        ):
            labels = f'{mine},namespace="{namespace}",pool="{pool}"'
            for state, count in (("ready", ready), ("unready", wanted - ready), ("claimed", claimed)):
                yield f'understudy_pool_pods{{{labels},state="{state}"}} {count}'
            yield f"understudy_pool_desired_pods{{{labels}}} {wanted}"
            waiting = int(pool == "amr-spare" and dry.holds(now))
            yield f"understudy_pool_waiting_workloads{{{labels}}} {waiting}"


def _condition(labels: str, condition: str, lacking: str | None, usual: str) -> str:
    told = f'{labels},condition="{condition}",reason="{lacking or usual}"'
    return f"understudy_workload_condition{{{told}}} {int(lacking is None)}"


def moments(end: float) -> Iterator[float]:
    """When it was scraped."""
    return every(SCRAPED, end - LENGTH, end)


def fleet(end: float) -> Operator:
    """The fleet, with all that befell it until a moment."""
    chance = random.Random(12)

    def failure(at: float, strategy: str, waited: float = 0.0) -> Failure:
        parts = {part: seconds * chance.uniform(0.98, 1.2) for part, seconds in PARTS[strategy].items()}
        parts["detection"] = 0.5 + chance.expovariate(1 / 0.003)
        parts["cluster"] += waited
        return Failure(at, strategy, parts, waited=waited)

    lost = end + NODE_LOST
    robots = []
    for number in range(1, 11):
        hot = number not in (3, 8)
        at = [end - LENGTH * chance.uniform(0.02, 0.98) for _ in range(chance.choice((0, 1, 1, 2)))]
        failures = [failure(when, EXECUTING if hot else chance.choice((UNINITIALIZED, RESTART))) for when in at]
        if number in (3, 7, 8):
            strategy = EXECUTING if hot else UNINITIALIZED
            failures.append(failure(lost + number / 10, strategy, waited=DRY - 2 if number == 8 else 0.0))
        if number == 7:
            failures += [
                failure(end - 52 * 60, EXECUTING),
                failure(end - 11 * 60, EXECUTING),
                failure(end - 5 * 60, RESTART),
            ]
        if number == 5:
            parts = {"detection": 0.5, "cluster": 3.0, "startup": 60.0, "reinitialization": 0.0}
            failures.append(Failure(end - 44 * 60, "none", parts, result="Failed"))
        unprotected = [Spell(f.at, f.over + 40, "StandbyNotReady") for f in failures if f.strategy == EXECUTING]
        if number == 8:
            unprotected.append(Spell(lost, lost + DRY, "PoolEmpty"))
        if number == 2:
            unprotected.append(Spell(end - 130, end + HOUR, "MonitorNotReady"))
        robots.append(
            Robot(
                f"amr-{number:02}-navigation", 10 + number, end - 30 * HOUR,
                {"/cmd_vel": 20, "/scan": 10, "/odom": 50, "/amcl_pose": 2},
                sorted(failures, key=lambda f: f.at), ("pose", "costmap", "parameters"),
                degraded=[Spell(end - 38 * 60, end - 33 * 60), Spell(end - 3 * 60, end + HOUR)] if number in (4, 7) else [],
                unprotected=unprotected,
                starved=[Spell(end - 22 * 60, end - 17 * 60)] if number == 7 else [],
            )
        )  # fmt: skip
    for number in (1, 2):
        failures = [failure(end - LENGTH * chance.uniform(0.02, 0.98), EXECUTING) for _ in range(2)]
        robots.append(
            Robot(
                f"arm-{number:02}-manipulation", 30 + number, end - 30 * HOUR,
                {"/joint_commands": 100, "/joint_states": 100}, sorted(failures, key=lambda f: f.at), namespace="lab",
                unprotected=[Spell(end - 420, end + HOUR, "StandbyNotReady")] if number == 2 else [],
            )
        )  # fmt: skip
    return Operator(robots, end)
