"""Keeps the state of the active instance: captures it, persists it, reports it, and gives it to waiting standbys.

state/state_capture.py determines the last healthy state; this module connects it to ROS, the agents, the disk and the
status. It never blocks the monitor's loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import AsyncIterator, Coroutine, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.kinds.state_spec import KeptStatus, RestoredState, State
from understudy.api.protocol.kept_state import KeptState
from understudy.clock import ClockSteps
from understudy.failover.interfaces import Instance
from understudy.failover.progress import rfc3339
from understudy.kube.agent_client import AgentGone, AgentRefused
from understudy.monitor.notices import Notices, StateKept
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.ros.observe.state_samples import StateSamples
from understudy.ros.runtime.graph_node import Graph
from understudy.state.pose_propagation import Carrier
from understudy.state.state_capture import Entry, Keeper, Key, Trouble
from understudy.state.state_store import StateSource, StateStore

_logger = logging.getLogger(__name__)

LEAST_READ_PERIOD = 0.05
"""Minimum seconds between two reads of the kept topics, if the policy's period is shorter. The middleware keeps the
last message in between."""

ODOMETRY_PERIOD = 0.1
"""Seconds between two reads of odometry. Only the last message of each interval counts: at 0.5 m/s and 1 rad/s the path between
two of them is known to a millimetre, and a jump can be distinguished from driving.
"""

UNCARRIED_FOR = 10.0
"""Seconds after which it is reported that a pose cannot be propagated."""

PERSIST = 1.0
"""Minimum seconds between two writes to the disk."""

INSPECT = 2.0
"""Seconds between two requests for parameters and lifecycle states."""

INSPECT_WITHIN = 3.0
"""Maximum seconds that the answer to such a request may take."""

REPORT_PERIOD = 30.0
"""Seconds between two updates of the status if only ages have changed."""

REASONS: tuple[Trouble, ...] = ("NotWatched", "TooBig", "NeverCame", "NotAsked", "TooOld", "NotCarried")
"""Reasons of the condition StateKept, the most serious first."""

Health = Literal["Starting", "Healthy", "Failed"]


class StateManager:
    """The kept state of one workload."""

    def __init__(self, graph: Graph, shelf: StateStore, agents: AgentConnections, notices: Notices) -> None:
        """Load the state that an earlier monitor kept."""
        self._capturing = StateSamples(graph)
        self._shelf, self._agents, self._notices = shelf, agents, notices
        self._keeper = Keeper()
        self._odometry, self._carrier = StateSamples(graph), Carrier()
        self._next_odometry = 0.0
        self._uncarried: dict[str, float] = {}
        self._state: State | None = None
        self._adopted = shelf.load()
        self.source = shelf.source if self._adopted else None
        """The instance from which state is kept; None if that is not known."""
        self.adopted_nothing = False
        """Whether nothing of the earlier monitor's state can be restored, because of the policy or because it is too old."""
        self._steps = ClockSteps()
        self._period = self._next_take = 0.0
        self._active = ""
        self._driver = ""
        """UID of the instance that is active, or was active last."""
        self._persisted: tuple[object, ...] = self._revision
        self._persisting: asyncio.Task[None] | None = None
        self._next_persist = 0.0
        self._persist_again = False
        """Whether what is new is to be stored as soon as the present write has ended."""
        self._inspecting: asyncio.Task[None] | None = None
        self._next_inspect = 0.0
        self._unanswered: dict[Key, str] = {}
        self.taken: dict[str, float] = {}
        """When each part of the state that would be restored now was captured, in Unix seconds."""
        self._reported: tuple[object, ...] = ()
        self._next_report = 0.0
        self._upkeep: dict[str, _Upkeep] = {}

    # -- each evaluation --------------------------------------------------------------------------------------------

    def take(self, state: State, instances: Mapping[str, str], active: str) -> None:
        """Capture the messages of kept topics that have arrived. ``instances`` maps pod names to IPs; ``active`` is the
        name of the active pod."""
        if state is not self._state:  # comparing the contents would cost more than the rest of this function
            self.follow(state)
        if not self._keeper.keys:
            return
        self._follow_clock()
        if self._capturing.attribute(instances, active) or active != self._active:
            self._active = active
            self._keeper.forget_offers()
        now = time.monotonic()
        if now >= self._next_take:
            self._next_take = now + max(LEAST_READ_PERIOD, self._period)
            self._take_messages()
        if self._carrier.topics:
            # Odometry is read after the poses, so that it covers the stamps of most of them.
            self._odometry.attribute(instances, active)
            self._take_odometry(now)

    def _take_messages(self) -> None:
        for message in self._capturing.drain():
            self._carrier.kept(message.topic, message.data, taken_at=message.taken_at)
            self._keeper.offer(
                Key("Topic", message.topic),
                message.data,
                taken_at=message.taken_at,
                received_at=message.received_at,
                type=message.type,
                standing=message.standing,
            )

    def _take_odometry(self, now: float) -> None:
        if now < self._next_odometry:
            return
        self._next_odometry = now + ODOMETRY_PERIOD
        for message in self._odometry.drain():
            self._carrier.moved(
                message.topic, message.type, message.data, received_at=message.received_at, writer=message.writer
            )
        self._carrier.settle(time.time())

    @contextlib.asynccontextmanager
    async def recovering(self) -> AsyncIterator[None]:
        """Continue to read odometry during a recovery, so that a reset of odometry is noticed."""

        async def watch() -> None:
            while True:
                self._take_odometry(time.monotonic())
                await asyncio.sleep(ODOMETRY_PERIOD)

        watching = asyncio.create_task(watch()) if self._carrier.topics else None
        try:
            yield
        finally:
            if watching is not None:
                watching.cancel()

    def judge(self, health: Health, now: float) -> None:
        """Count captured state as healthy if the instance was healthy then, and is now. ``now`` is in Unix seconds."""
        self._keeper.judge(health, now)

    def follow(self, state: State) -> None:
        """Keep the state that this policy names. Matching state that an earlier monitor kept is adopted."""
        if state == self._state:
            self._state = state
            return
        is_first = self._state is None
        self._state, self._period = state, seconds(state.period)
        self._keeper.follow(state)
        self._capturing.follow({topic.topic: topic.type for topic in state.keep})
        self._carrier.follow(state)
        self._odometry.follow(dict(self._carrier.topics))
        if self._adopted:
            # Only now is it known which parts are still needed: the policy may have changed since they were stored.
            self._keeper.adopt(self._adopted, time.time())
            self._carrier.adopt(self._adopted)
            self._adopted = {}
            kept = self._keeper.select(time.time())
            self.adopted_nothing = not (kept.samples or kept.parameters or kept.lifecycle)
        if is_first:
            self._persisted = self._revision  # nothing is new, and another monitor may have stored more meanwhile

    def _follow_clock(self) -> None:
        """Shift all times if the clock was set, so that ages stay as they are."""
        if step := self._steps.taken():
            self._keeper.shift(step)
            self._capturing.shift(step)
            self._odometry.shift(step)
            self._carrier.shift(step)

    # -- restoring --------------------------------------------------------------------------------------------------

    def select(self, onset: float) -> KeptState:
        """Return the state for the instance that takes over after a failure that began at ``onset`` (Unix seconds)."""
        self._follow_clock()
        if self._carrier.topics:
            self._take_odometry(time.monotonic())
        return self._carrier.carry(self._keeper.select(onset), time.time())

    def select_for_recovery(self, onset: float) -> KeptState:
        """Return the same as :meth:`select`, and store it at once: if this monitor ends, the next one restores the same state."""
        selected = self.select(onset)
        self._persist(time.monotonic(), at_once=True)
        return selected

    def awaited(self) -> str:
        """Return why the state of the active instance is not known yet, as after a start of this monitor; empty if it is, or was waited for
        long enough."""
        names = self._keeper.awaited(time.time())
        return (
            f"this monitor has not yet received {', '.join(names)} of {self._active}, which is to be kept"
            if names
            else ""
        )

    def report_restored(self, recovery: Recovery) -> None:
        """Report what happened to the state in a recovery."""
        if not recovery.state:
            if recovery.result == "Recovered":
                self._notices.withdraw(
                    "StateRestored"
                )  # the report about an earlier recovery does not apply to this one
            return
        missing = [entry for entry in recovery.state if not entry.restored]
        restored = ", ".join(f"{e.name} ({_age_text(e)})" for e in recovery.state if e.restored)
        notes = "; ".join(f"{e.name}: {e.message}" for e in recovery.state if e.restored and e.message)
        uncarried = [e for e in recovery.state if e.restored and e.message and e.carried_metres is None]
        if not missing:
            text = f"{recovery.to_pod} was given {restored}." + (f" {notes}." if notes else "")
            if not uncarried:
                self._notices.condition("StateRestored", "True", "Restored", text)
                return
            self._notices.condition("StateRestored", "False", "NotCarried", text)
            self._notices.event("Warning", "StateNotCarried", text)
            return
        reasons = "; ".join(f"{entry.name}: {entry.message}{self._place(entry.name)}" for entry in missing)
        text = f"{recovery.to_pod or 'No pod'} did not receive all of the kept state: {reasons}."
        message = text + (f" It received {restored}." if restored else "") + (f" {notes}." if notes else "")
        way_out = " It took over nevertheless. To prevent that, use a restore_state step in the strategy's recovery."
        self._notices.condition("StateRestored", "False", "NotRestored", message + way_out)
        self._notices.event("Warning", "StateNotRestored", text + way_out)

    def _place(self, label: str) -> str:
        """Return where the policy names a kept part, for messages; empty if it no longer does."""
        state = self._state
        if state is None:
            return ""
        keys = [
            *((Key("Topic", kept.topic), f"keep[{i}]") for i, kept in enumerate(state.keep)),
            *((Key("Parameters", kept.node), f"parameters[{i}]") for i, kept in enumerate(state.parameters)),
            *((Key("Lifecycle", node), f"lifecycle[{i}]") for i, node in enumerate(state.lifecycle)),
        ]
        return next((f" (state.{place} of the policy)" for key, place in keys if key.label == label), "")

    # -- not urgent -------------------------------------------------------------------------------------------------

    def housekeeping(
        self,
        active: Instance | None,
        waiting: Sequence[tuple[Instance, float]],
        source: StateSource | None = None,
    ) -> None:
        """Persist the state, request parameters and lifecycle states, report, and give standbys state. ``waiting`` has
        those standbys, each with its period in seconds; ``source`` identifies the active instance and its processes.
        Called about once a second; returns at once.
        """
        now = time.monotonic()
        if self._state is None:
            return
        if active is not None:
            self._driver = active.uid
        if source is not None and self._keeper.keys and self._keeper.healthy_since is not None:
            self.source = source
        self._persist(now)
        self._follow_other_monitor(now)
        if self._keeper.keys or self._reported:
            self._inspect(now, active)
            self._note()
            self._report(now)
        self._keep_up(waiting, now)

    @property
    def _revision(self) -> tuple[object, ...]:
        """What changes whenever there is something new to store."""
        return (self._keeper.revision + self._carrier.revision, self.source)

    @property
    def _is_disk_busy(self) -> bool:
        return self._persisting is not None and not self._persisting.done()

    def _persist(self, now: float, *, at_once: bool = False) -> None:
        busy, source, revision = self._is_disk_busy, self.source, self._revision
        self._persist_again |= busy and at_once
        if busy or (now < self._next_persist and not at_once) or revision == self._persisted or self._adopted:
            return
        self._next_persist = now + PERSIST
        kept = self._keeper.versions()
        self._carrier.prune(self._keeper.held())
        kept |= self._carrier.packed(time.time())

        async def persist() -> None:
            try:
                await asyncio.to_thread(self._shelf.save, kept, source)
                self._persisted, self.adopted_nothing = revision, False
            except OSError as error:
                _logger.error("could not store the kept state, so it is lost if the monitor restarts: %s", error)
            self._persist_if_selected()

        self._persisting = asyncio.create_task(persist())

    def _persist_if_selected(self) -> None:
        """Store the state that a recovery selected while the disk was busy."""
        if self._persist_again:
            self._persist_again, self._persisting = False, None
            self._persist(time.monotonic(), at_once=True)

    def _follow_other_monitor(self, now: float) -> None:
        """Adopt what another monitor of this workload has stored, while this one does not receive a healthy instance.

        After the loss of a node that comes back, two monitors run for a while, and the new one may not hear the instance: DDS discovery
        can last. Poses that are propagated are not adopted, because the odometry that this monitor received belongs to those that it has.
        """
        if self._is_disk_busy or self._adopted or now < self._next_persist or not self._keeper.keys:
            return
        if self._keeper.healthy_since is not None or not self._driver:
            return
        self._next_persist = now + PERSIST

        async def adopt(driver: str) -> None:
            found = await asyncio.to_thread(self._shelf.load_foreign, driver)
            if found and driver == self._driver and self._keeper.healthy_since is None:
                own = {key: versions for key, versions in found.items() if key.name not in self._carrier.poses}
                self._keeper.adopt(own, time.time())
                self.source = self._shelf.source
                self._persisted = self._revision
            self._persist_if_selected()

        self._persisting = asyncio.create_task(adopt(self._driver))

    def _inspect(self, now: float, active: Instance | None) -> None:
        state = self._state
        assert state is not None, "it was checked before"
        if not (state.parameters or state.lifecycle) or now < self._next_inspect:
            return
        if self._inspecting is not None and not self._inspecting.done():
            return
        self._next_inspect = now + INSPECT
        keys = [Key("Parameters", p.node) for p in state.parameters] + [Key("Lifecycle", n) for n in state.lifecycle]
        if active is not None and not active.has_agent:
            reason = f"pod {active.name} has no agent, because the controller in workloadRef created it"
            self._unanswered = dict.fromkeys(keys, reason)
        elif active is not None and self._keeper.healthy_since is not None:
            self._inspecting = asyncio.create_task(self._ask(active, state, keys))

    async def _ask(self, active: Instance, state: State, keys: Sequence[Key]) -> None:
        body = {
            "parameters": [{"node": p.node, "names": p.names} for p in state.parameters],
            "lifecycle": list(state.lifecycle),
        }
        asked = time.time()
        try:
            answer = await self._agents.inspect(active, body, INSPECT_WITHIN)
        except (AgentGone, AgentRefused) as error:
            self._unanswered = dict.fromkeys(keys, str(error))
            return
        since = self._keeper.healthy_since
        self._unanswered = {
            Key("Parameters" if p.get("kind") == "parameters" else "Lifecycle", str(p.get("node"))): str(
                p.get("reason")
            )
            for p in answer.get("problems", [])
        }
        if state != self._state or active.name != self._active or since is None or asked < since:
            return
        for key, data in _answers(answer):
            self._keeper.offer(key, data, taken_at=asked, received_at=time.time())

    def _troubles(self) -> list[Entry]:
        """Return the entries of all kept parts, each with its problem, also that it cannot be propagated."""
        now, entries = time.time(), self._keeper.entries(time.time())
        if not self._carrier.topics:
            return entries
        self._carrier.note({**self._odometry.waiting, **self._odometry.problems})
        reasons = self._carrier.reasons(self._keeper.select(now), now)
        self._uncarried = {name: self._uncarried.get(name, now) for name in reasons}
        lasting = {name: reasons[name] for name, since in self._uncarried.items() if now - since > UNCARRIED_FOR}
        return [
            replace(entry, trouble="NotCarried", message=f"{entry.key.label}: {lasting[entry.key.name]}")
            if entry.trouble is None and entry.key.kind == "Topic" and entry.key.name in lasting
            else entry
            for entry in entries
        ]

    def _note(self) -> None:
        notes: dict[Key, tuple[Trouble, str]] = {}
        for name, reason in self._capturing.waiting.items():
            notes[Key("Topic", name)] = ("NeverCame", f"{name}: {reason}")
        for name, problem in self._capturing.problems.items():
            notes[Key("Topic", name)] = ("NotWatched", f"{name}: {problem}")
        for key, reason in self._unanswered.items():
            notes[key] = ("NotAsked", f"{key.label}: {reason}")
        self._keeper.note(notes)

    def _report(self, now: float) -> None:
        """Update status, condition and metrics: at once if a problem begins or ends, else every REPORT_PERIOD seconds."""
        entries = self._troubles()
        self._notices.add(StateKept({entry.key.label: (entry.taken_at, entry.bytes) for entry in entries}))
        self.taken = {entry.key.label: entry.taken_at for entry in entries if entry.taken_at is not None}
        shape = tuple((entry.key, entry.trouble, entry.taken_at is None) for entry in entries)
        if shape == self._reported and now < self._next_report:
            return
        self._reported, self._next_report = shape, now + REPORT_PERIOD
        self._notices.set_kept_state([_status(entry) for entry in entries])
        if not entries:
            self._notices.condition(
                "StateKept", "True", "NothingToKeep", "spec.state of the policy names nothing to keep."
            )
            return
        troubled = sorted((e for e in entries if e.trouble), key=lambda e: REASONS.index(e.trouble))
        if troubled:
            text = ". ".join(f"{entry.message}{self._place(entry.key.label)}" for entry in troubled) + "."
            if any(entry.trouble == "NeverCame" for entry in troubled):
                text += (
                    " State that was never received cannot be restored on the instance that takes over. Correct the topic's name "
                    "in the policy, or let the application publish it."
                )
            reason = "TypeNotInstalled" if "not installed" in text else str(troubled[0].trouble)
            if self._notices.condition("StateKept", "False", reason, text):
                self._notices.event("Warning", f"State{reason}", text)
        elif missing := [entry.key.label for entry in entries if entry.taken_at is None]:
            text = f"Waiting for {', '.join(missing)} of a healthy instance."
            self._notices.condition("StateKept", "Unknown", "Waiting", text)
        else:
            names = ", ".join(entry.key.label for entry in entries)
            self._notices.condition("StateKept", "True", "Kept", f"Keeping {names}.")

    def _keep_up(self, waiting: Sequence[tuple[Instance, float]], now: float) -> None:
        """Give waiting standbys the state that has changed since they were given state last."""
        state = self._state
        assert state is not None, "it was checked before"
        known = {instance.uid for instance, _ in waiting}
        for uid in [uid for uid in self._upkeep if uid not in known]:
            self._upkeep.pop(uid).cancel()
        for instance, period in waiting:
            upkeep = self._upkeep.setdefault(instance.uid, _Upkeep())
            if now >= upkeep.due and not upkeep.busy and self._keeper.healthy_since is not None:
                upkeep.due = now + period
                # Without the lifecycle states, which would make the standby drive too early.
                fresh = replace(self.select(time.time()), lifecycle=(), left_out=()).changed_from(upkeep.restored)
                if fresh:
                    upkeep.begin(self._restore(instance, fresh, upkeep, seconds(state.within)))

    async def _restore(self, instance: Instance, fresh: KeptState, upkeep: _Upkeep, within: float) -> None:
        report = await self._agents.restore(instance, fresh, within)
        restored_names = {entry.name for entry in report.restored}
        upkeep.restored |= {name: content for name, content in fresh.contents().items() if name in restored_names}
        if report.problem != upkeep.problem:
            upkeep.problem = report.problem
            if report.problem:
                self._notices.event("Warning", "StandbyNotKeptUp", f"{instance.name}: {report.problem}")


def _age_text(entry: RestoredState) -> str:
    """Say how old the state was, and by what distance it was propagated."""
    age = f"{entry.age_seconds:.1f} s old"
    return age if entry.carried_metres is None else f"{age}, propagated by {entry.carried_metres:.2f} m"


def _answers(answer: Mapping[str, Any]) -> Iterator[tuple[Key, bytes]]:
    """Yield parameters and lifecycle states as nodes reported them. Only the states unconfigured, inactive and active can be restored."""
    for node, values in answer.get("parameters", {}).items():
        yield Key("Parameters", node), json.dumps(values, sort_keys=True).encode()
    for node, state in answer.get("lifecycle", {}).items():
        if state in ("unconfigured", "inactive", "active"):
            yield Key("Lifecycle", node), str(state).encode()


def _status(entry: Entry) -> KeptStatus:
    return KeptStatus(
        name=entry.key.name,
        kind=entry.key.kind,
        taken_at=f"{rfc3339(entry.taken_at)[:19]}Z" if entry.taken_at is not None else None,
        bytes=entry.bytes,
        message=entry.message,
    )


class _Upkeep:
    """The state that one waiting standby was given, and when it gets more."""

    def __init__(self) -> None:
        self.due = 0.0
        self.restored: dict[str, object] = {}
        """The contents that were restored last, by name."""
        self.problem = ""
        self._task: asyncio.Task[None] | None = None

    @property
    def busy(self) -> bool:
        return self._task is not None and not self._task.done()

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        self._task = asyncio.create_task(work)

    def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
