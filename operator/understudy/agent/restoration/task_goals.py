"""Goals of the workload's tasks at this pod's instance. The agent is the only client of the instance's action servers.

The servers are in a DDS partition of this pod's own (ros/dds/profiles.py), so what the agent sends reaches this
instance alone. The agent sends changes as events; a proxy that missed some asks for all goals. A goal is sent once
under its id. If it is requested again, also from an agent that was restarted in the meantime, the agent finds it at the
server and follows it.
"""

from __future__ import annotations

import asyncio
import base64
import builtins
import contextlib
import itertools
import json
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from understudy.agent.control_channel import Operation, Peer, Refused
from understudy.api.protocol import agent_messages as wire

if TYPE_CHECKING:
    from understudy.ros.actions.action_endpoints import ActionClient, ActionType
    from understudy.ros.actions.calling_node import GraphLocation
    from understudy.ros.runtime.served_node import ServedNode

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.05
"""Seconds between checks for a server that a goal waits for."""

WATCH = 1.0
"""Seconds between checks of whether the server of a goal is still the one that accepted it."""

ANSWER = 5.0
"""Seconds for a server's answer to a goal, or to its cancellation."""

RESOLVED = 3.0
"""Seconds after which a server that gives no result for a goal is assumed to know it: for an unknown goal it answers at
once."""

AGAIN = 5.0
"""Seconds after which the result is requested again."""

MOST_REJECTED = 16
"""Rejected goals that are remembered: another proxy may order one too, and it must not be executed after the client was answered."""

MOST_KEPT = 64
"""Ended goals that are remembered, in case the proxy missed their end."""

MOST_BYTES = wire.MAX_LINE // 2
"""Bytes of the goals in one answer. For a goal that does not fit, the proxy sends its order again, and is informed in an event."""

MOST_IN_EVENT = (wire.MAX_LINE - 4096) // 4 * 3
"""Bytes of a serialized result or feedback that fit into one event, in base64."""

_UNKNOWN, _CANCELED, _ABORTED = 0, 5, 6
_OPEN = ("waiting", "running")


@dataclass
class _Record:
    """A goal that was requested."""

    id: str
    action: str
    type: str
    data: bytes
    note: str
    """Kept for a proxy that asks for all goals."""
    state: str = "waiting"
    """waiting (for the server), running, rejected, ended, lost."""
    status: int = _UNKNOWN
    result: bytes = b""
    withdrawn: bool = False
    """Whether the proxy cancelled it without a client's request."""
    concluded: bool = False
    """Whether the proxy has cancelled it after its end: the end counts for its client."""
    cancelled: bool = False
    """Whether the proxy has cancelled it, and not withdrawn, so that no instance needs it any more. The instance may not answer that."""
    ended: float = 0.0
    """Monotonic seconds."""
    task: asyncio.Task[None] | None = None

    def to_wire(self) -> dict[str, Any]:
        result = base64.b64encode(self.result).decode()
        return {"id": self.id, "state": self.state, "status": self.status, "result": result}


class TaskGoals:
    """Sends goals to the instance and follows them."""

    def __init__(
        self, name: str, place: Callable[[], GraphLocation | None], publish: Callable[[Mapping[str, Any]], None]
    ) -> None:
        """``name`` is that of the node, which is created at the first goal.

        ``place`` returns this process's location in the ROS graph, None while it has not joined; ``publish`` sends an
        event.
        """
        self._name, self._place, self._publish = name, place, publish
        self._records: dict[str, _Record] = {}
        self._servers: dict[str, ActionClient] = {}
        self._served: ServedNode | None = None
        self._joined: GraphLocation | None = None
        self._opening = asyncio.Lock()
        self._numbers = itertools.count(1)
        self._resent: dict[int, asyncio.Future[None]] = {}

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that the task proxy can request."""
        return {"goal": self.goal, "cancel": self.cancel, "goals": self.list, "resent": self.resent}

    async def goal(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Send a goal to the instance when its server is present. Repeating the request changes nothing.

        Raises Refused.
        """
        id, action, type_name, data = _checked(body)
        note = str(body.get("note", ""))
        known = self._records.get(id)
        if known is not None:
            known.note = note
            self._repeat_end(known)
            return
        await asyncio.to_thread(_type, type_name)
        record = self._records[id] = _Record(id, action, type_name, data, note)
        record.task = asyncio.create_task(self._follow(record), name=f"goal {id}")
        self._forget()

    async def cancel(self, body: Mapping[str, Any], peer: Peer) -> dict[str, Any]:
        """Ask the instance to cancel a goal. Returns whether it accepts, and whether the goal is known at all.

        Raises Refused.
        """
        record = self._records.get(str(body.get("goal")))
        if record is None or record.state not in _OPEN:
            if record is not None:
                record.withdrawn &= body.get("withdrawn") is True
                record.concluded |= body.get("withdrawn") is not True
                self._repeat_end(record)
            return {"known": record is not None and record.state == "ended", "accepted": False}
        record.withdrawn = body.get("withdrawn") is True
        record.cancelled = not record.withdrawn
        if record.state == "waiting":
            if record.task is not None:
                record.task.cancel()
            self._change(record, "ended", status=_CANCELED)
            return {"known": True, "accepted": True}
        server = await self._server(record)
        try:
            async with asyncio.timeout(ANSWER):
                code = await server.cancel(record.id)
        except TimeoutError:
            raise Refused(f"{record.action}: no answer to a cancel within {ANSWER:g} s") from None
        # If the goal has ended in the meantime, an event reports it.
        accepted = code in (0, 3)
        record.cancelled &= accepted
        return {"known": True, "accepted": accepted}

    async def list(self, body: Mapping[str, Any], peer: Peer) -> dict[str, Any]:
        """Return the goals that were requested, with their states: the unfinished ones first, then the latest, as many as fit."""
        now, size = time.monotonic(), 0
        goals: builtins.list[Mapping[str, Any]] = []
        for record in sorted(self._records.values(), key=lambda one: (one.state not in _OPEN, -one.ended)):
            # An aborted or withdrawn goal may have to be sent again.
            is_needed = record.state in _OPEN or (
                record.state == "ended" and not record.concluded and (record.status == _ABORTED or record.withdrawn)
            )
            goal = {
                **record.to_wire(),
                "note": record.note,
                "withdrawn": record.withdrawn,
                "cancelled": record.cancelled,
                "data": base64.b64encode(record.data).decode() if is_needed else "",
                "ago": now - record.ended if record.ended else 0.0,
            }
            length = len(json.dumps(goal))
            if size + length <= MOST_BYTES:
                goals.append(goal)
                size += length
        return {"goals": goals}

    async def resent(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Record that the proxy has sent the goals that :meth:`resend` requested."""
        waiting = self._resent.get(body.get("number", 0))
        if waiting is not None and not waiting.done():
            waiting.set_result(None)

    async def resend(self, within: float) -> None:
        """Request that the task proxy sends unfinished goals to this instance. Raises TimeoutError if no proxy does."""
        number = next(self._numbers)
        future = self._resent[number] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(within):
                while not future.done():
                    # Repeated, because the proxy may only just be connecting.
                    self._publish({"resendGoals": number})
                    await asyncio.wait([future], timeout=WATCH)
        except TimeoutError:
            raise TimeoutError(
                f"no task proxy sent goals within {within:g} s: does the workload have spec.tasks?"
            ) from None
        finally:
            del self._resent[number]

    async def close(self) -> None:
        """Stop following all goals."""
        for record in self._records.values():
            if record.task is not None:
                record.task.cancel()
        if self._served is not None:
            await self._served.close()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _repeat_end(self, record: _Record) -> None:
        """Send the end of a goal again, for a proxy that missed it and for which it was too large among others."""
        if record.state not in _OPEN:
            self._publish({"goal": record.to_wire()})

    def _change(self, record: _Record, state: str, *, status: int = _UNKNOWN, result: bytes = b"") -> None:
        if len(result) > MOST_IN_EVENT:
            _logger.error("the result of goal %s has %d bytes, so it is left out", record.id, len(result))
            result = b""
        record.state, record.status, record.result = state, status, result
        record.ended = time.monotonic() if state not in _OPEN else 0.0
        _logger.info("goal %s of %s: %s%s", record.id, record.action, state, f", status {status}" if status else "")
        self._publish({"goal": record.to_wire()})

    def _forget(self) -> None:
        closed = [record for record in self._records.values() if record.state not in _OPEN]
        rejected = [record for record in closed if record.state == "rejected"]
        ended = [record for record in closed if record.state != "rejected"]
        for record in rejected[:-MOST_REJECTED] + ended[:-MOST_KEPT]:
            del self._records[record.id]

    async def _follow(self, record: _Record) -> None:
        """Send a goal and report its progress."""
        while record.state in _OPEN:
            try:
                await self._follow_at(record, await self._server(record))
            except asyncio.CancelledError:
                raise
            except Exception:
                _logger.exception("goal %s of %s", record.id, record.action)
                await asyncio.sleep(WATCH)

    async def _follow_at(self, record: _Record, server: ActionClient) -> None:
        while not await server.ready():
            await asyncio.sleep(CHECK_PERIOD)
            if self._moved():
                return
        if record.state == "waiting":
            try:
                async with asyncio.timeout(ANSWER):
                    accepted, _ = await server.send_goal(record.id, record.data)
            except TimeoutError:
                return  # it may have been accepted: the next attempt finds out
            if not accepted and not await self._is_known(record, server):
                self._change(record, "rejected")
                return
            self._change(record, "running")
        await self._await_end(record, server)

    async def _is_known(self, record: _Record, server: ActionClient) -> bool:
        """Whether a server rejects a goal because it already has the goal, from an earlier agent of this pod."""
        asking = asyncio.ensure_future(server.result(record.id))
        try:
            await asyncio.wait([asking], timeout=RESOLVED)
            return not asking.done() or asking.result()[0] != _UNKNOWN
        finally:
            asking.cancel()

    async def _await_end(self, record: _Record, server: ActionClient) -> None:
        """Wait for the result.

        It is requested again if another process serves the action, because that process does not know the request. It
        is also requested again at intervals, since a server that is starved of CPU drops the answer to a client that it
        has not matched in time.
        """
        asking = asyncio.ensure_future(server.result(record.id))
        try:
            serving = await self._serving(record.action)
            again = time.monotonic() + AGAIN
            while not asking.done():
                await asyncio.wait([asking], timeout=WATCH)
                if self._moved():
                    return
                now = await self._serving(record.action)
                if asking.done():
                    break
                if not now:
                    self._change(record, "lost")
                    return
                if now - serving or time.monotonic() >= again:
                    serving, again = now, time.monotonic() + AGAIN
                    asking.cancel()
                    asking = asyncio.ensure_future(server.result(record.id))
            status, result = asking.result()
        finally:
            asking.cancel()
        if status == _UNKNOWN:
            self._change(record, "lost")
        else:
            self._change(record, "ended", status=status, result=result)

    async def _serving(self, action: str) -> set[bytes]:
        """Return the GIDs of this host's servers of an action."""
        from understudy.ros.rmw import MIDDLEWARE

        served, joined = self._served, self._joined
        assert served is not None
        assert joined is not None
        topic = f"rq{action}/_action/send_goalRequest"
        infos = await served.get(lambda: served.node.get_subscriptions_info_by_topic(topic, no_mangle=True))
        gids = {bytes(info.endpoint_gid)[:16] for info in infos}
        return {gid for gid in gids if joined.host is None or MIDDLEWARE.host_of(gid) == joined.host}

    def _moved(self) -> bool:
        """Whether this process has left the graph that it had joined, for example after an error."""
        place = self._place()
        return place is None or self._joined is None or place.context is not self._joined.context

    async def _server(self, record: _Record) -> ActionClient:
        """Return the client of an action, in the present graph."""
        async with self._opening:
            place = self._place()
            while place is None:
                await asyncio.sleep(CHECK_PERIOD)
                place = self._place()
            if self._joined is None or self._joined.context is not place.context:
                await self._join(place)
            if record.action not in self._servers:
                assert self._served is not None
                self._servers[record.action] = await self._open(record.action, record.type, self._served)
            return self._servers[record.action]

    async def _join(self, place: GraphLocation) -> None:
        from understudy.ros.runtime.served_node import ServedNode

        if self._served is not None:
            with contextlib.suppress(Exception):
                await self._served.close()
        self._servers.clear()
        self._served, self._joined = ServedNode(self._name, context=place.context), place

    async def _open(self, action: str, type_name: str, served: ServedNode) -> ActionClient:
        from understudy.ros.actions.action_endpoints import ActionClient

        client = ActionClient(served, action, _type(type_name), on_feedback=self._on_feedback)
        await client.open()
        return client

    def _on_feedback(self, goal: str, data: bytes) -> None:
        record = self._records.get(goal)
        if record is not None and record.state in _OPEN and len(data) <= MOST_IN_EVENT:
            self._publish({"feedback": {"id": goal, "data": base64.b64encode(data).decode()}})


def _checked(body: Mapping[str, Any]) -> tuple[str, str, str, bytes]:
    """Return id, action, type and data of a request. Raises Refused."""
    id, action, type_name = (body.get(key) for key in ("goal", "action", "type"))
    if not isinstance(id, str) or len(id) != 32 or not isinstance(action, str) or not isinstance(type_name, str):
        raise Refused(f"expected goal (32 hex digits), action and type, found {id!r}, {action!r}, {type_name!r}")
    try:
        bytes.fromhex(id)
        return id, action, type_name, base64.b64decode(body.get("data", ""), validate=True)
    except (TypeError, ValueError) as error:
        raise Refused(f"goal {id!r}: {error}") from error


def _type(name: str) -> ActionType:
    """Return the types of an action. Raises Refused."""
    from understudy.ros.runtime.lean_imports import import_rclpy

    import_rclpy()
    from understudy.ros.actions.action_endpoints import ActionType
    from understudy.ros.runtime.interface_types import TypeNotInstalled

    try:
        return ActionType.of(name)
    except (TypeNotInstalled, ValueError) as error:
        raise Refused(str(error)) from error
