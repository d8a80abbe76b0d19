"""The steps that strategies share."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncIterator, Collection, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass

from understudy.api.protocol.kept_state import KeptState
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import StrategyContext

_logger = logging.getLogger(__name__)

ENFORCED_WITHIN = 1.0
"""Seconds to wait for packets that prove that the gate is open. After that, samples at the gated readers are the proof."""

MOMENT = 0.1
"""Minimum time of a step in seconds, so that it can report why it failed."""

ANSWER = 1.0
"""Seconds before the end of a strategy's time at which its procedure ends at the latest, so that it can report the leaf that failed; if
the time is short, no more than a quarter of it."""

CLOSED_FOR = 0.06
"""Seconds without a packet of any other instance after which the gate counts as closed for them. An agent sends one every 10 ms at
least, and packets are read every 20 ms (kube/gates/probes.py)."""

PROBE_SECONDS = 2.0
"""Seconds for which probes are sent around a commit."""

OUTAGE_CHECK_PERIOD = 0.05
"""Seconds between two checks of whether the API server answers."""

CLOCK_RESOLUTION = 0.001
"""Seconds that the clock distinguishes at least."""

OUTAGE_REPORTED = 0.5
"""Minimum seconds without an answer of the API server that the record of an attempt names."""

LATE_BY, LATE_FACTOR, LATE_AT_MOST = 10.0, 30.0, 120.0
"""For how many seconds after an outage of the API server the network may not know the present gate yet: the first, and so many times the
outage, but at most the last. A network engine asks again after pauses that double, up to 30 s, and up to twice as long by chance
(client-go). An API server that has just started refuses it at first, because it has not loaded the roles, which makes the pauses longer.
Cilium was 8 to 95 s late after outages of 4 to 10 s."""


def committed_target(progress: Progress, context: StrategyContext) -> Instance | None:
    """Return the instance for which an interrupted run of this recovery already opened the gate."""
    if not is_committed(progress, context):
        return None
    uid = context.gate.state.active_uid
    target = next((i for i in context.instances.of_workload() if i.uid == uid and i.usable), None)
    if target is not None:
        progress.target = PodIdentity(name=target.name, uid=target.uid)
    return target


def is_committed(progress: Progress, context: StrategyContext) -> bool:
    """Whether an interrupted run of this recovery already opened the gate for an instance."""
    state = context.gate.state
    is_own = state.recovery is not None and state.recovery.id == progress.id
    return is_own and not state.closed and not progress.has_failed(state.active_uid)


def on_other_nodes_first(
    candidates: Iterable[Instance], progress: Progress, context: StrategyContext
) -> list[Instance]:
    """Return the candidates in their order, but those on the nodes of failed instances last.

    The node may be what failed, and Kubernetes reports that only some time later.
    """
    failed = {i.node for i in context.instances.of_workload() if progress.has_failed(i.uid)} - {""}
    return sorted(candidates, key=lambda i: i.node in failed)


def claim_of(progress: Progress, context: StrategyContext) -> str:
    """Return the text of a claim: it names the workload and the recovery."""
    return f"{context.workload_uid}/{progress.id}"


async def join(me: Waiter, progress: Progress, context: StrategyContext) -> None:
    """Record next to the gate that this workload waits for a pod. This closes the gate: a failed instance does not drive meanwhile."""
    progress.moments["queued"] = me.since
    progress.waiting = me
    context.save(progress)
    beside = context.gate.state.recovery
    recorded = beside.waiting if beside is not None else None
    waits = recorded is not None and (recorded.pool, recorded.priority) == (me.pool, me.priority)
    if not waits or not _is_closed(progress, context):
        await context.gate.commit(None, progress)
    progress.moments.setdefault("fenced", context.clock())


async def close(progress: Progress, context: StrategyContext) -> None:
    """Close the gate, which fences every instance.

    A gate that is closed without a commit is a new one: somebody deleted the former one. While there is none, nobody knows whether the
    instance failed or only could not reach the robot, so nothing is done to it.
    """
    while not context.gate.exists:  # noqa: ASYNC110 - each kind of gate would need an event for what nobody does twice
        await asyncio.sleep(MOMENT)
    if not _is_closed(progress, context):
        await context.gate.commit(None, progress)
    progress.moments.setdefault("fenced", context.clock())


async def close_and_see(target: Instance, progress: Progress, context: StrategyContext, *, within: float) -> None:
    """Close the gate, and wait until no packet of another instance than the target passes it.

    Packets show that a gate is open, and only their absence that it is closed. So the agents of the former instances send one every few
    milliseconds. A former instance without a working agent may not be heard. Raises NotVerified.
    """
    end, state = loop_time() + max(MOMENT, within - MOMENT), context.gate.state
    for instance in context.instances.of_workload():
        if instance.uid in (state.active_uid, state.admitted_uid):
            await context.agents.probe(instance, PROBE_SECONDS)
    await close(progress, context)
    closed = context.clock()
    while True:
        last, pod = last_sign(target, progress, context)
        if (left := max(closed, last) + CLOSED_FOR - context.clock()) <= 0:
            break
        if loop_time() >= end and not network_is_late(progress, context):
            raise NotVerified(f"{pod} still reaches the robot, although the gate is closed (handover: BreakBeforeMake)")
        await asyncio.sleep(min(left, CLOSED_FOR / 4))


def last_sign(target: Instance, progress: Progress, context: StrategyContext) -> tuple[float, str]:
    """Return when another instance last reached the robot, by samples and by packets through the gate, and which; 0 if none did."""
    others = {uid: name for uid, name in _known(progress, context).items() if uid != target.uid}
    last, pod = max([context.outputs.last_from_others(target), *_last_packets(others, context)])
    return min(last, context.clock()), pod


def _known(progress: Progress, context: StrategyContext) -> dict[str, str]:
    """Return the names of all pods that may send, by their UIDs."""
    pods = {pod.uid: pod.name for pod in context.gate.state.pinned} | {pod.uid: pod.name for pod in progress.replaced}
    return pods | {i.uid: i.name for i in context.instances.of_workload()}


def _last_packets(pods: Mapping[str, str], context: StrategyContext) -> list[tuple[float, str]]:
    """Return when a packet of each pod last passed the gate, and its name."""
    found = ((context.gate.last_packet(uid), name) for uid, name in pods.items())
    return [(packet, name) for packet, name in found if packet is not None]


def _is_closed(progress: Progress, context: StrategyContext) -> bool:
    """Whether a commit has closed the gate, and not for another recovery. Whether that may be ended is decided by the next commit."""
    state = context.gate.state
    return state.closed and state.epoch != progress.open_at and progress.another(state.recovery) is None


async def open_for(target: Instance, progress: Progress, context: StrategyContext) -> None:
    """Open the gate for one instance and for no other: one write fences the former instance and routes this one."""
    progress.target = PodIdentity(name=target.name, uid=target.uid)
    progress.moments["committing"] = began = context.clock()
    # Without an answer of the API server, the gate may have been switched already, and nobody is commanded.
    is_away = context.gate.unanswered_since is not None
    committing = asyncio.create_task(context.gate.commit(target, progress))
    try:
        # The commit carries the progress, so its request leaves first: it is created in one round of the event loop and
        # written in the next.
        for _ in range(2):
            await asyncio.sleep(0)
        if not is_away:
            await context.agents.probe(target, PROBE_SECONDS)
        context.save(progress)
        await committing
    finally:
        committing.cancel()
    progress.moments["committed"] = committed = context.clock()
    if is_away or committed - began >= PROBE_SECONDS:
        await context.agents.probe(target, PROBE_SECONDS)
    await _probe_others(target, context)


async def _probe_others(target: Instance, context: StrategyContext) -> None:
    """Have all instances but one send test packets: a standby may leak too, and sends only one a second by itself."""
    for instance in context.instances.of_workload():
        if instance.uid != target.uid:
            await context.agents.probe(instance, PROBE_SECONDS)


async def start_answered(target: Instance, context: StrategyContext, *, within: float) -> None:
    """Start the processes of a held pod. Raises NotVerified if its agent does not answer for so long, while the API server does."""
    starting = asyncio.create_task(context.agents.start(target))
    away = False
    try:
        while not (await asyncio.wait((starting,), timeout=within))[0]:
            was_away, away = away, context.gate.unanswered_since is not None
            if not away and not was_away:
                place = f" on node {target.node}" if target.node else ""
                raise NotVerified(f"the agent of pod {target.name}{place} did not answer within {within:.3g} s")
        starting.result()
    finally:
        starting.cancel()


async def started(target: Instance, progress: Progress, context: StrategyContext) -> None:
    """Wait until the processes of a new instance are up: the end of the paper's t_startup."""
    if target.has_agent:
        up = await context.agents.up(target)
        progress.moments["started"] = up
        progress.charge("startup", up)


async def make_drivable(
    target: Instance, progress: Progress, context: StrategyContext, recovery: BringUp | None, *, within: float
) -> None:
    """Prepare a started instance to drive while another one is active, with the kept state of the active one.

    Raises NotVerified.
    """
    end = loop_time() + within
    progress.target = PodIdentity(name=target.name, uid=target.uid)
    await give_state_and_bring_up(target, progress, context, recovery, end=end)
    if target.has_agent:
        progress.moments["ready"] = await context.agents.ready(target)
        return
    await context.instances.wait(lambda i: i.uid == target.uid and i.ready)
    progress.moments["ready"] = context.clock()


async def bring_up_and_open(
    target: Instance, progress: Progress, context: StrategyContext, recovery: BringUp | None, *, end: float
) -> None:
    """Prepare a started instance to drive, and open the gate for it.

    Restoring state, running the procedure and waiting for its outputs are the paper's t_re-initialization. ``end`` is the end of the
    strategy's time, by the clock of the event loop.
    """
    while True:
        restarts = _restarts(target, context)
        missing = await give_state_and_bring_up(target, progress, context, recovery, end=end)
        given = context.clock()
        if target.has_agent:
            was_ready, _ = context.agents.is_ready(target)
            try:
                # An application may need a response of the robot before it publishes: half the time is left for opening the gate first.
                async with asyncio.timeout(max(MOMENT, (end - loop_time()) / 2)):
                    ready = await context.agents.ready(target)
                progress.moments["ready"] = ready
            except TimeoutError:
                was_ready, ready = True, context.clock()
            progress.charge("reinitialization", ready)
            # Time to open the gate is left, also if all of this time is needed.
            has_time = end - loop_time() > 2 * (context.restore_within + context.expiry) + MOMENT
            if missing and not was_ready and has_time:
                # It was starting, or had stopped, when its state was to be restored.
                await restore(target, progress, context, only=missing)
                given = context.clock()
                progress.charge("reinitialization", given)
        if _restarts(target, context) == restarts:
            break
        _logger.info("%s has restarted since it was given its state: it is given again", target.name)
    progress.given_restarts = restarts if any(entry.restored for entry in progress.state) else None
    await _expired(given, progress, context)
    await open_for(target, progress, context)
    await wait_enforced(target, progress, context)


def _restarts(target: Instance, context: StrategyContext) -> int:
    """How often the containers of an instance have restarted: their state is lost then."""
    found = context.instances.find(target.uid)
    return found.restarts if found is not None else 0


async def _expired(given: float, progress: Progress, context: StrategyContext) -> None:
    """Wait until commands that the instance sent before it had its state, and that its writer kept for the robot, have expired."""
    if any(entry.restored for entry in progress.state) and (left := given + context.expiry - context.clock()) > 0:
        await asyncio.sleep(left)
        progress.charge("reinitialization", context.clock())


async def give_state_and_bring_up(
    target: Instance, progress: Progress, context: StrategyContext, recovery: BringUp | None, *, end: float
) -> Collection[str]:
    """Restore the kept state to a started instance, and run the procedure that prepares it to drive.

    Returns the topics and nodes whose state the instance should have received and did not. A procedure that restores state judges itself.
    """
    missing: Collection[str] = ()
    if recovery is None or not recovery.restores_state or not target.has_agent:
        missing = await restore(target, progress, context)
    if recovery is not None and target.has_agent:
        rest = end - loop_time()
        within = min(recovery.within, max(MOMENT, rest - min(ANSWER, rest / 4)))
        state = kept(progress, context) if recovery.restores_state else KeptState()
        report = await context.agents.bring_up(target, recovery, within=within, state=state)
        progress.charge("reinitialization", context.clock())  # a standby's outputs were ready long ago
        if recovery.restores_state:
            progress.note_state(report)
            context.save(progress)
    return missing


@dataclass
class Outage:
    """For how long during an attempt the API server did not answer, or this process could see nobody, or the network was late."""

    seconds: float = 0.0
    blind: float = 0.0
    """Seconds besides in which discovery had reported nobody to this process."""
    network: float = 0.0
    """Seconds besides in which the network did not follow the gate yet, after an outage of the API server."""

    def beside(self, message: str = "") -> str:
        """Return a message about the attempt that names what does not count too, if it was long enough to matter."""
        found = []
        if self.seconds >= OUTAGE_REPORTED:
            found.append(f"the API server did not answer for {self.seconds:.1f} s")
        if self.blind >= OUTAGE_REPORTED:
            found.append(f"DDS discovery reported nobody to the monitor for {self.blind:.1f} s")
        if self.network >= OUTAGE_REPORTED:
            found.append(f"the network did not follow the gate for {self.network:.1f} s after the API server was back")
        if not found:
            return message
        away = " and ".join(found)
        return f"{message}; {away}, which do not count" if message else away


@asynccontextmanager
async def answered_time(
    within: float, progress: Progress, context: StrategyContext, outage: Outage | None = None
) -> AsyncIterator[None]:
    """Limit the context to ``within`` seconds in which the API server answers, the network follows the gate, and this process runs and has
    discovered somebody.

    An outage of the control plane or of discovery says nothing about an understudy: it is added to ``outage``. Raises TimeoutError.
    """
    async with asyncio.timeout(None) as limit:
        charging = asyncio.create_task(_charge(limit, within, progress, context, outage or Outage()))
        try:
            yield
        finally:
            charging.cancel()


async def _charge(
    limit: asyncio.Timeout, within: float, progress: Progress, context: StrategyContext, outage: Outage
) -> None:
    loop = asyncio.get_running_loop()
    charged, counted_until = 0.0, loop.time()
    while (left := within - charged) > CLOCK_RESOLUTION:  # a shorter sleep may pass without any time
        await asyncio.sleep(min(OUTAGE_CHECK_PERIOD, left))
        since, now = context.gate.unanswered_since, loop.time()
        answered = now - counted_until if since is None else max(0.0, since - counted_until)
        outage.seconds += now - counted_until - answered
        if context.outputs.blind:
            outage.blind += answered
        elif network_is_late(progress, context):
            outage.network += answered
        else:
            charged += min(answered, 2 * OUTAGE_CHECK_PERIOD)  # a longer sleep means that the process was stalled
        counted_until = now
    limit.reschedule(loop.time())


def network_is_late(progress: Progress, context: StrategyContext) -> bool:
    """Whether the network has not applied what the gate says since the last outage of the API server, and may do so soon.

    No packet of an instance passes although the gate names it and its agent reports that it is ready; or one of another instance does
    although the gate is closed. Each strategy needs the network, so none would be faster.
    """
    if (outage := context.gate.last_outage) is None:
        return False
    began, ended = outage
    if loop_time() >= ended + min(LATE_AT_MOST, LATE_BY + LATE_FACTOR * (ended - began)):
        return False
    moments, state = progress.moments, context.gate.state
    if state.closed:
        fenced = moments.get("fenced", math.inf)
        return any(packet > fenced for packet, _ in _last_packets(_known(progress, context), context))
    target = context.instances.find(progress.target.uid) if progress.target is not None else None
    if target is None or target.uid != state.active_uid or not target.has_agent:
        return False
    passed = context.gate.last_packet(target.uid) or 0.0
    return passed < moments.get("committing", 0.0) and context.agents.is_ready(target)[0]


def timeline(moments: dict[str, float], *steps: str) -> str:
    """Return when steps were done relative to the decision, as text."""
    decided = moments.get("decided", 0.0)
    return ", ".join(f"{step} {(moments[step] - decided) * 1000:+.1f} ms" for step in steps if step in moments)


def loop_time() -> float:
    """Return the time of the event loop in seconds."""
    return asyncio.get_running_loop().time()


async def restore(
    target: Instance, progress: Progress, context: StrategyContext, *, only: Collection[str] = ()
) -> Collection[str]:
    """Restore the state of the last healthy instance to a started one, as far as possible; with ``only``, only that of these topics and
    nodes. Returns the topics and nodes for which it failed.

    State that cannot be restored is recorded and does not stop the recovery: a robot without an active instance is worse off than one whose
    application starts without some of its state. A recovery tree can insist on the state (restore_state).
    """
    state = kept(progress, context).only(only)
    if not state and not state.left_out:
        return ()
    if target.has_agent:
        report = await context.agents.restore(target, state, context.restore_within)
    else:
        report = state.none_restored(f"pod {target.name} has no agent, because Understudy did not create it")
    progress.note_state(report)
    context.save(progress)
    return {entry.name.split(" ")[0] for entry in report.failed}


def kept(progress: Progress, context: StrategyContext) -> KeptState:
    """Return the state to restore after this failure; it is the same each time."""
    return context.kept(progress.moments.get("last_healthy", progress.cursor))


async def wait_enforced(target: Instance, progress: Progress, context: StrategyContext) -> None:
    """Record when the gate was enforced: by its probes, or by the commit if the instance has no agent."""
    since = progress.moments.get("committing", progress.cursor)
    routed = progress.moments.get("committed", context.clock())
    if target.has_agent:
        try:
            async with asyncio.timeout(ENFORCED_WITHIN):
                routed = await context.gate.enforced(target, since=since)
        except TimeoutError:
            routed = context.clock()
    progress.moments["routed"] = routed
    progress.charge("cluster", routed)
    _logger.info("gate for %s: %s", target.name, timeline(progress.moments, "committing", "committed", "routed"))
    # One commit fences the failed pod and routes the understudy. Whether the failed pod is silent from then on is verified later.
    progress.moments.setdefault("fenced", routed)


async def enforced_target(progress: Progress, context: StrategyContext) -> Instance | None:
    """Return the instance for which an interrupted run of this recovery already opened the gate, once that is enforced."""
    target = committed_target(progress, context)
    if target is not None:
        await wait_enforced(target, progress, context)
    return target
