"""The proxy's connection to one instance's agent: sends orders, and passes on events."""

from __future__ import annotations

import asyncio
import base64
import logging
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from understudy.action_proxy.client_goals import AttemptState
from understudy.action_proxy.control_state import Peer
from understudy.action_proxy.goal_ledger import Order
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.api.protocol.secure_channel import MonitorSecret
from understudy.kube.agent_client import AgentGone, AgentLink, AgentRefused

_logger = logging.getLogger(__name__)

RETRY = 1.0
"""Seconds after which a request is repeated that an agent refused or did not answer."""

MOST_CANCELS = 16
"""Cancels under way at one agent. It carries out twice as many requests at the same time."""

WITHIN = 10.0
"""Seconds for an answer: the agent asks its instance to cancel, which may take a while."""

_STATES = {
    "running": AttemptState.RUNNING,
    "rejected": AttemptState.REJECTED,
    "ended": AttemptState.ENDED,
    "lost": AttemptState.LOST,
}


class Listener(Protocol):
    """Receives what an instance reports."""

    def connection_changed(self, uid: str, connected: bool) -> None:
        """Called when the connection to the instance's agent is made, and when it has ended."""

    def epoch(self) -> GateEpoch:
        """Return the epoch of the gate as the monitor reported it last."""

    def orders(self, uid: str) -> Sequence[Order]:
        """Return the goals that the instance must have."""

    def goal_found(self, uid: str, goal: Mapping[str, Any]) -> None:
        """Called for a goal that the instance has, maybe from an earlier proxy."""

    def goal_reported(self, uid: str, id: str, at: AttemptState, status: int, result: str) -> None:
        """Called with the state of one of its goals."""

    def cancel_answered(self, uid: str, id: str, accepted: bool) -> None:
        """Called with the instance's answer to a cancel."""

    def feedback_received(self, uid: str, id: str, data: bytes) -> None:
        """Called with the feedback of a goal, as a serialized message."""

    def resend_requested(self, uid: str) -> None:
        """Called when its recovery tree requests the unfinished goals."""

    def goal_problem(self, uid: str, action: str, problem: str) -> None:
        """Called with the reason why it cannot receive a goal of an action; empty once it has received one."""


class InstanceLink:
    """The connection to one instance. Retries until closed."""

    def __init__(self, peer: Peer, workload: str, listener: Listener) -> None:
        self.peer, self._listener = peer, listener
        self._wake = asyncio.Event()
        self._asked = self._connected = False
        self._sent: dict[str, str] = {}
        """By id, the note with which the agent has the goal."""
        self._mine: set[str] = set()
        """Goals that were ordered and have not ended. A goal that is no longer ordered is cancelled."""
        self._cancelled: dict[str, bool] = {}
        """By id, whether it was cancelled as withdrawn."""
        self._cancelling: dict[tuple[str, bool], asyncio.Task[None]] = {}
        """By id and whether it is withdrawn: an application that stands still does not answer, and other orders do not wait for it."""
        self._invitations: list[int] = []
        self._link = AgentLink(
            peer.ip,
            peer.port,
            MonitorSecret(peer.token.encode(), bytes.fromhex(peer.key)),
            workload,
            peer.claim,
            uid=peer.uid,
            pod=peer.pod,
            protocol=peer.protocol,
            epoch=listener.epoch,
            on_change=self._changed,
            on_event=self._event,
        )
        self._task = asyncio.create_task(self._run(), name=f"goals of {peer.pod}")

    def wake(self) -> None:
        """Read the orders again."""
        self._wake.set()

    def ask_again(self) -> None:
        """Ask the agent for all its goals again."""
        self._asked = False
        self._wake.set()

    async def close(self) -> None:
        """Close the connection."""
        working = [self._task, *self._cancelling.values()]
        for task in working:
            task.cancel()
        await asyncio.gather(*working, return_exceptions=True)
        await self._link.close()

    def _changed(self, link: AgentLink) -> None:
        if link.connected != self._connected:
            self._connected = link.connected
            self._listener.connection_changed(self.peer.uid, link.connected)
        if not link.connected:
            # Events without a connection are lost, so everything is requested again.
            self._asked = False
            self._sent.clear()
            self._cancelled.clear()
        elif not self._asked:
            self._wake.set()

    def _event(self, link: AgentLink, event: Mapping[str, Any]) -> None:
        if "feedback" in event:
            found = event["feedback"]
            self._listener.feedback_received(self.peer.uid, found["id"], base64.b64decode(found["data"]))
        elif "goal" in event:
            self._goal_reported(event["goal"])
        elif "resendGoals" in event:
            self._invitations.append(event["resendGoals"])
            self._listener.resend_requested(self.peer.uid)
            self._wake.set()

    def _goal_reported(self, found: Mapping[str, Any]) -> None:
        at = _STATES.get(found["state"])
        if at is None:
            return
        if at is not AttemptState.RUNNING:
            self._sent.pop(found["id"], None)
            self._mine.discard(found["id"])
        self._listener.goal_reported(self.peer.uid, found["id"], at, int(found["status"]), found["result"])

    async def _run(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            if not self._link.connected:
                continue
            try:
                await self._carry_out()
            except Exception as error:
                self._retry(error)

    def _retry(self, error: Exception) -> None:
        expected = isinstance(error, AgentGone | AgentRefused)
        _logger.warning("%s: %s", self.peer.pod, error, exc_info=None if expected else error)
        asyncio.get_running_loop().call_later(RETRY, self._wake.set)

    async def _carry_out(self) -> None:
        if not self._asked:
            self._asked = True
            try:
                answer = await self._link.request("goals", {}, within=WITHIN)
            except (AgentGone, AgentRefused):
                self._asked = False
                raise
            for found in answer.get("goals", []):
                if found["state"] in ("waiting", "running"):
                    self._sent[found["id"]] = found.get("note", "")
                self._listener.goal_found(self.peer.uid, found)
                self._goal_reported(found)
        for id in sorted(self._mine - {order.id for order in self._listener.orders(self.peer.uid)}):
            if self._cancelled.get(id) is False:
                self._mine.discard(id)  # it was ordered to, and has been done
            else:
                self._cancel(id)
        refused: AgentRefused | None = None
        seen: set[str] = set()
        # Orders change while others are sent: a goal that the instance has rejected meanwhile must not be sent again at once.
        while (order := next((o for o in self._listener.orders(self.peer.uid) if o.id not in seen), None)) is not None:
            seen.add(order.id)
            if order.held:
                continue
            self._mine.add(order.id)
            try:
                if order.cancel:
                    self._cancel(order.id, ordered=True, withdrawn=order.withdrawn)
                else:
                    self._cancelled.pop(order.id, None)
                    await self._send(order)
            except AgentRefused as error:
                refused = error  # other goals, for example of another action, continue
        invitations, self._invitations = self._invitations, []
        for number in dict.fromkeys(invitations):
            await self._link.request("resent", {"number": number}, within=WITHIN)
        if refused is not None:
            raise refused

    async def _send(self, order: Order) -> None:
        if self._sent.get(order.id) == order.note:
            return
        body = {
            "goal": order.id,
            "action": order.action,
            "type": order.type,
            "data": order.data,
            "note": order.note,
        }
        # Noted before the answer, because the first event about the goal may arrive before it.
        self._sent[order.id] = order.note
        try:
            await self._link.request("goal", body, within=WITHIN)
        except AgentRefused as error:
            self._sent.pop(order.id, None)
            self._listener.goal_problem(self.peer.uid, order.action, f"pod {self.peer.pod}: {error}")
            raise
        except AgentGone:
            self._sent.pop(order.id, None)
            raise
        self._listener.goal_problem(self.peer.uid, order.action, "")

    def _cancel(self, id: str, *, ordered: bool = False, withdrawn: bool = False) -> None:
        """Cancel a goal, unless that was done or is being done. With too many under way, it waits for one of them."""
        key = id, withdrawn
        if (
            self._cancelled.get(id) != withdrawn
            and key not in self._cancelling
            and len(self._cancelling) < MOST_CANCELS
        ):
            self._cancelling[key] = asyncio.create_task(self._cancel_at_agent(id, ordered=ordered, withdrawn=withdrawn))

    async def _cancel_at_agent(self, id: str, *, ordered: bool, withdrawn: bool) -> None:
        try:
            answer = await self._link.request("cancel", {"goal": id, "withdrawn": withdrawn}, within=WITHIN)
            if not ordered:
                self._mine.discard(id)
                return
            self._cancelled[id] = withdrawn
            if answer.get("known"):
                self._listener.cancel_answered(self.peer.uid, id, bool(answer.get("accepted")))
            else:
                self._listener.goal_reported(self.peer.uid, id, AttemptState.LOST, 0, "")
        except Exception as error:
            self._retry(error)
        finally:
            del self._cancelling[id, withdrawn]
            if len(self._cancelling) == MOST_CANCELS - 1:
                self._wake.set()
