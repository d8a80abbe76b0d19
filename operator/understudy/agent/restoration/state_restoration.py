"""Restores kept state to this pod's instance, and reads what the monitor cannot observe.

Every step can be repeated with the same effect: setting a parameter, bringing a node to a state, publishing a message.
Parameters come first, since some are read only when a node is configured. Messages wait for their subscribers, which
may appear with a node's transition, so both proceed at the same time.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from understudy.agent.control_channel import Operation, Peer, Refused
from understudy.agent.restoration.pose_restoration import PoseOutcome, PosePublication, present
from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.kept_state import (
    KeptSample,
    KeptState,
    LifecycleState,
    NotRestored,
    ParameterValues,
    Restored,
    RestoreReport,
)

if TYPE_CHECKING:
    from understudy.ros.actions.instance_calls import InstanceCaller

_logger = logging.getLogger(__name__)

SAY_AGAIN = 1.5
"""Seconds without a confirmation after which a message is published again: a node may not have been ready for the
first."""

LAST_MOMENT = 0.05
"""Seconds before the end at which single steps give up, so that their results are reported in time."""

INSPECT_WITHIN = 3.0
"""Maximum seconds for an inspection, if the request does not give them."""

Item = KeptSample | ParameterValues | LifecycleState


class StateRestorer:
    """Restores and inspects state. ROS is imported when it is first needed."""

    def __init__(self, caller: Callable[[], InstanceCaller]) -> None:
        """``caller`` returns the calls to this pod's instance."""
        self._caller = caller

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that a monitor can request."""
        return {"restore": self._on_restore, "inspect": self._on_inspect}

    # -- restoring --------------------------------------------------------------------------------------------------

    async def restore(self, state: KeptState, *, within: float, only: Collection[str] = ()) -> RestoreReport:
        """Restore this state within ``within`` seconds.

        With ``only``, only the part of it that belongs to these topics and nodes is restored. The report lists what could not be restored,
        and why. No error is raised for that.
        """
        end = time.monotonic() + within - LAST_MOMENT
        restored: list[Restored] = []
        missing: list[NotRestored] = list(state.only(only).left_out)
        # If there is no state at all, this is the first instance, and missing state is no failure.
        some = state != KeptState()
        for name in only:
            if not state.only([name]) and not state.only([name]).left_out:
                reason = "it is not among what the policy keeps and restores" if some else "nothing is kept yet"
                missing.append(NotRestored(name, reason, failed=some))
        state = state.only(only)

        async def attempt(item: Item, give: Callable[[float], Awaitable[PoseOutcome | None]]) -> None:
            from understudy.ros.actions.instance_calls import CallFailed

            try:
                carried = await give(max(0.0, end - time.monotonic()))
            except CallFailed as error:
                missing.append(NotRestored(item.name, str(error)))
            except Exception as error:
                _logger.exception("restoring %s", item.name)
                missing.append(NotRestored(item.name, f"restoring it failed: {error!r}"))
            else:
                metres, note = (carried.metres, carried.note) if carried is not None else (None, "")
                restored.append(Restored(item.name, item.taken_at, metres, note))

        async def nodes() -> None:
            # In the policy's order: a managed node may need the one before it.
            for node in state.lifecycle:
                await attempt(node, partial(self._bring, node))

        await asyncio.gather(*(attempt(values, partial(self._set, values)) for values in state.parameters))
        samples = (attempt(sample, partial(self._publish_sample, sample)) for sample in state.restored_samples)
        await asyncio.gather(nodes(), *samples)
        return RestoreReport(tuple(restored), tuple(missing))

    async def _set(self, parameters: ParameterValues, within: float) -> None:
        await self._caller().set_parameters(parameters.node, parameters.values, within)

    async def _bring(self, node: LifecycleState, within: float) -> None:
        await self._caller().bring_to(node.node, node.state, within)

    async def _publish_sample(self, sample: KeptSample, within: float) -> PoseOutcome | None:
        """Publish a message until the instance has it. Returns the outcome for a pose that is to be propagated.

        Raises CallFailed.
        """
        from understudy.ros.runtime.lean_imports import rclpy_imported

        end = time.monotonic() + within
        caller = self._caller()
        await rclpy_imported()  # the message needs rclpy for its stamp, perhaps while this process joins the ROS graph
        async with present(caller, sample, max(0.0, end - time.monotonic())) as publication:
            await self._publish(caller, sample, publication, end)
            return publication.outcome

    async def _publish(
        self, caller: InstanceCaller, sample: KeptSample, publication: PosePublication, end: float
    ) -> None:
        within = max(0.0, end - time.monotonic())
        if not sample.confirm:
            await caller.publish(sample.to, sample.type, publication.message, within, answered=True)
            return
        since = time.time()
        confirmed = asyncio.create_task(self._confirmed(sample, since, within))
        try:
            while True:
                await caller.publish(sample.to, sample.type, publication.message, max(0.0, end - time.monotonic()))
                last = time.monotonic() + SAY_AGAIN >= end
                await asyncio.wait([confirmed], timeout=None if last else SAY_AGAIN)
                if confirmed.done():
                    await confirmed
                    return
        finally:
            confirmed.cancel()
            await asyncio.wait([confirmed])
            if not confirmed.cancelled():
                confirmed.exception()  # the error is reported, or publishing failed first

    async def _confirmed(self, sample: KeptSample, since: float, within: float) -> None:
        """Wait until the instance has published on the topic that confirms the message. Raises CallFailed."""
        from understudy.ros.actions.instance_calls import CallFailed

        caller, end = self._caller(), time.monotonic() + within
        try:
            if sample.confirm == sample.topic:
                type_name = sample.type
            else:
                type_name = await caller.topic_type(sample.confirm, within)
            rest = max(0.0, end - time.monotonic())
            await caller.wait_sample(sample.confirm, type_name, rest, since=since, own=True)
        except CallFailed as error:
            raise CallFailed(
                f"the kept message was published on {sample.to}, but {sample.confirm} did not confirm it: {error}"
            ) from error

    async def _on_restore(self, body: Mapping[str, Any], peer: Peer) -> Mapping[str, Any]:
        try:
            state = KeptState.from_wire(body.get("state") or {})
        except ProtocolError as error:
            raise Refused(str(error)) from error
        report = await self.restore(state, within=_within(body, 5.0))
        return {"report": report.to_wire()}

    # -- inspecting -------------------------------------------------------------------------------------------------

    async def inspect(
        self, parameters: Mapping[str, Sequence[str]], lifecycle: Sequence[str], *, within: float
    ) -> dict[str, Any]:
        """Return values of parameters, states of managed nodes, and why some could not be determined, each by node."""
        from understudy.ros.actions.instance_calls import CallFailed

        found: dict[str, Any] = {"parameters": {}, "lifecycle": {}, "problems": []}

        async def ask(kind: str, node: str, answer: Awaitable[Any]) -> None:
            try:
                found[kind][node] = await answer
            except CallFailed as error:
                found["problems"].append({"kind": kind, "node": node, "reason": str(error)})

        caller = self._caller()
        rest = max(0.0, within - LAST_MOMENT)
        await asyncio.gather(
            *(ask("parameters", n, caller.get_parameters(n, names, rest)) for n, names in parameters.items()),
            *(ask("lifecycle", node, caller.lifecycle_state(node, rest)) for node in lifecycle),
        )
        return found

    async def _on_inspect(self, body: Mapping[str, Any], peer: Peer) -> Mapping[str, Any]:
        parameters, lifecycle = body.get("parameters", []), body.get("lifecycle", [])
        try:
            wanted = {str(entry["node"]): [str(name) for name in entry["names"]] for entry in parameters}
            nodes = [str(node) for node in lifecycle]
        except (TypeError, KeyError, AttributeError) as error:
            raise Refused("parameters is a list of node and names, lifecycle one of nodes") from error
        return await self.inspect(wanted, nodes, within=_within(body, INSPECT_WITHIN))


def _within(body: Mapping[str, Any], usual: float) -> float:
    within = body.get("within", usual)
    if not isinstance(within, int | float) or isinstance(within, bool) or not 0 < within <= 3600:
        raise Refused(f"within {within!r}: expected a number of seconds, up to 3600")
    return float(within)
