"""Runs procedures and checks on this pod's instance (trees/languages/short/procedure_loader.py)."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from understudy.agent.control_channel import Operation, Peer, Refused
from understudy.api.protocol.agent_messages import GAVE_WAY, ProtocolError
from understudy.api.protocol.kept_state import KeptState, RestoreReport

if TYPE_CHECKING:
    from understudy.agent.instance_health import InstanceHealth
    from understudy.ros.actions.instance_calls import InstanceCaller
    from understudy.trees.core.health_tree import HealthTree, Verdict, WatchedTopic
    from understudy.trees.languages.short.procedure_loader import ProcedureTree

_logger = logging.getLogger(__name__)

LONGEST = 24 * 3600.0
"""Maximum seconds for a procedure."""

CHECKED_WITHIN = 2.0
"""Maximum seconds for one evaluation of a check, if its period is not longer."""

Restore = Callable[..., Awaitable[RestoreReport]]
"""``(state, *, within, only)``, as in :class:`understudy.agent.restoration.state_restoration.StateRestorer`."""


def places_of(data: object) -> Mapping[str, str]:
    """Return where the nodes of a tree were written, from the monitor's request; empty for the short form.

    Raises ValueError.
    """
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        raise ValueError(f"places is a mapping, not {data!r:.100}")
    return {str(inner): str(place) for inner, place in data.items()}


class InstanceActions:
    """Implements :class:`understudy.trees.core.procedure_steps.Actions` for this pod's instance."""

    def __init__(
        self,
        caller: InstanceCaller,
        watched: InstanceHealth,
        restore: Restore,
        resend: Callable[[float], Awaitable[None]],
        state: KeptState,
    ) -> None:
        self._watched, self._restore, self._resend, self._state = watched, restore, resend, state
        self.report = RestoreReport()
        """The outcome of restoring the state so far."""
        # Nodes that have just started may not have discovered the publisher yet.
        self.publish = partial(caller.publish, answered=True)
        self.call, self.wait_sample = caller.call, caller.wait_sample
        self.service_present, self.node_present = caller.service_present, caller.node_present
        self.lifecycle_state, self.bring_to = caller.lifecycle_state, caller.bring_to
        self.get_parameters, self.set_parameters = caller.get_parameters, caller.set_parameters

    async def restore_state(self, only: Sequence[str] | None, within: float) -> None:
        """Restore the kept state that came with the request.

        State that is too old or was never kept is reported, and is no failure.
        """
        report = await self._restore(self._state, within=within, only=only or ())
        self.report = self.report.merged(report)
        if report.problem:
            raise RuntimeError(report.problem)

    async def resend_goals(self, within: float) -> None:
        """Request that the action proxy sends unfinished goals to the instance."""
        await self._resend(within)

    def health(self, tree: HealthTree) -> Verdict:
        """Return a health tree's present verdict on the instance."""
        return self._watched.verdict(tree)


class ProcedureRunner:
    """Runs one procedure at a time. A newer one replaces the one that runs."""

    def __init__(
        self,
        actions: Callable[[KeptState], InstanceActions],
        watch: Callable[[str, Sequence[WatchedTopic]], None],
        *,
        on_begin: Callable[[str, str], None],
        on_success: Callable[[str, str], None],
        on_end: Callable[[], None],
    ) -> None:
        """``actions`` creates the actions on the instance for a kept state; ``watch`` watches topics for a purpose.

        ``on_begin`` and ``on_success`` receive the procedure's name and the name under which its success is remembered.
        """
        self._actions, self._watch = actions, watch
        self._on_begin, self._on_success, self._on_end = on_begin, on_success, on_end
        self._running: asyncio.Task[None] | None = None
        self.doing = ""
        """Name of the procedure that runs."""
        self.failure = ""
        """Why the last procedure failed; empty if it did not."""

    @property
    def summary(self) -> str:
        """Return which procedure runs, or how the last one failed."""
        return f"{self.doing} is under way" if self.doing else self.failure

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that a monitor can request."""
        return {"procedure": self._on_procedure}

    async def _on_procedure(self, body: Mapping[str, Any], peer: Peer) -> Mapping[str, Any]:
        from understudy.trees.core.procedure_steps import ProcedureFailed
        from understudy.trees.languages.short.procedure_loader import load_procedure

        name, within, token = str(body.get("name") or "procedure"), body.get("within"), str(body.get("as") or "")
        if not isinstance(within, int | float) or isinstance(within, bool) or not 0 < within <= LONGEST:
            raise Refused(f"within {within!r}: expected a number of seconds, up to {LONGEST:g}")
        try:
            places = places_of(body.get("places"))
            tree = await asyncio.to_thread(load_procedure, body.get("tree"), path=name, places=places)
            actions = self._actions(KeptState.from_wire(body.get("state") or {}))
        except (ValueError, ProtocolError) as error:
            raise Refused(str(error)) from error
        before, this = self._running, asyncio.create_task(self._run(tree, actions, float(within), name, token))
        self._running = this
        try:
            if before is not None and not before.done():
                before.cancel()
            await asyncio.wait([this])
        finally:
            if not this.done():  # the session has ended: the next monitor repeats the request
                this.cancel()
                await asyncio.wait([this])
        if this.cancelled():
            raise Refused(f"{name} {GAVE_WAY}")
        try:
            this.result()
        except ProcedureFailed as error:
            raise Refused(str(error)) from error
        return {"report": actions.report.to_wire()}

    async def _run(self, tree: ProcedureTree, actions: InstanceActions, within: float, name: str, token: str) -> None:
        started = asyncio.get_running_loop().time()
        self.doing, self.failure = name, ""
        self._on_begin(name, token)
        self._watch("procedure", tree.topics)
        _logger.info("%s begins", name)
        try:
            await tree.run(actions, within)
            _logger.info("%s done in %.2f s", name, asyncio.get_running_loop().time() - started)
            self._on_success(name, token)
        except Exception as error:
            _logger.warning("%s failed: %s", name, error)
            self.failure = str(error) or repr(error)
            raise
        finally:
            if self._running is asyncio.current_task():
                self.doing = ""
                self._watch("procedure", ())
                self._on_end()


class ReadinessCheck:
    """Evaluates a check periodically."""

    def __init__(self, tree: ProcedureTree, period: float, actions: Callable[[], InstanceActions]) -> None:
        """``period`` in seconds."""
        self.tree, self._period, self._actions = tree, period, actions
        self.reason = "not evaluated yet"
        """Why the check does not succeed; empty if it does. On a busy node one evaluation may fail, so only two
        failures in a row count."""

    async def run(self, on_change: Callable[[], None]) -> None:
        """Evaluate until cancelled."""
        from understudy.trees.core.procedure_steps import ProcedureFailed

        failures = 0
        while True:
            started = asyncio.get_running_loop().time()
            try:
                await self.tree.run(self._actions(), max(self._period, CHECKED_WITHIN))
                reason = ""
            except ProcedureFailed as error:
                reason = str(error)
            except Exception as error:
                _logger.exception("the readiness check")
                reason = f"it cannot be evaluated: {error!r}"
            failures = failures + 1 if reason else 0
            if reason != self.reason and (not reason or self.reason or failures > 1):
                self.reason = reason
                on_change()
            await asyncio.sleep(max(0.05, started + self._period - asyncio.get_running_loop().time()))
