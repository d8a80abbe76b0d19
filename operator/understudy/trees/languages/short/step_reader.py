"""Reads the leaves of procedures and checks: what each does to an instance, or which condition it checks."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from understudy.trees.core.health_tree import HealthTree, WatchedTopic
from understudy.trees.core.procedure_steps import Actions, ProcedureFailed, Work
from understudy.trees.languages.short.health_loader import load
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.lifecycle import STATES
from understudy.trees.source.problems import TreeError
from understudy.trees.source.value_reader import Reader, duration_of, found_text, name_of, type_of

SETTLE = 0.05
"""Seconds between two evaluations of a leaf that is still starting."""

_KEYS = {key: step.keys for key, step in (*procedure_leaves.STEPS.items(), *procedure_leaves.CONDITIONS.items())}
_EXAMPLES = {"node": "map_server", "service": "controller_server/get_state", "topic": "initialpose"}
_TYPES = {"srv": "std_srvs/srv/Trigger", "msg": "geometry_msgs/msg/Twist"}


class StepReader(Reader):
    """Reads leaves, and collects problems; a leaf with a problem reads as None."""

    def __init__(self, *, waits: bool) -> None:
        """``waits`` is True for a procedure, which waits for conditions; a check does not."""
        super().__init__()
        self.topics: list[WatchedTopic] = []
        """The topics that conditions need."""
        self._waits = waits

    def step(self, kind: str, fields: Mapping[str, Any], path: str) -> Work | None:
        """Return what a step or an instant condition does; None, with a problem, if it cannot be read."""
        self.known(fields, _KEYS[kind], path)
        work: Work | None = getattr(self, f"_{kind}")(fields, path)
        return work

    # -- actions ----------------------------------------------------------------------------------------------------

    def _set_lifecycle(self, fields: Mapping[str, Any], path: str) -> Work | None:
        node, state = self._ros(fields, "node", path), self._state(fields, path)

        async def work(actions: Actions, within: float) -> None:
            await actions.bring_to(str(node), str(state), within)

        return work

    def _call_service(self, fields: Mapping[str, Any], path: str) -> Work | None:
        service, type_ = self._ros(fields, "service", path), self._type(fields, path, "srv")
        request, expect = self._mapping(fields, "request", path), self._mapping(fields, "expect", path)
        repeat = self.optional(fields, "repeat", path, duration_of)

        async def work(actions: Actions, within: float) -> None:
            answer = await actions.call(str(service), str(type_), request, within, repeat=repeat)
            if (reason := _mismatch(answer, expect)) is not None:
                raise ProcedureFailed(f"service {service} gave another answer: {reason}")

        return work

    def _publish(self, fields: Mapping[str, Any], path: str) -> Work | None:
        topic, type_ = self._ros(fields, "topic", path), self._type(fields, path, "msg")
        message = self._mapping(fields, "message", path)

        async def work(actions: Actions, within: float) -> None:
            await actions.publish(str(topic), str(type_), message, within)

        return work

    def _set_parameters(self, fields: Mapping[str, Any], path: str) -> Work | None:
        node, values = self._ros(fields, "node", path), self._mapping(fields, "values", path)
        if not values:
            self.problem(f"{path}.values", "missing; give the parameters to set, such as {use_sim_time: true}")
        for name, value in values.items():
            if value is None or isinstance(value, Mapping):
                self.problem(
                    f"{path}.values.{name}", f"found {found_text(value)}; a parameter is a value or a list of them"
                )

        async def work(actions: Actions, within: float) -> None:
            await actions.set_parameters(str(node), values, within)

        return work

    def _wait_for(self, fields: Mapping[str, Any], path: str) -> Work | None:
        what = [key for key in ("topic", "service", "node") if key in fields]
        if len(what) != 1:
            self.problem(path, f"found {' and '.join(what) or 'none'} of topic, service and node; give exactly one")
            return None
        kind = what[0]
        name = self._ros(fields, kind, path)
        type_ = self._type(fields, path, "msg") if kind == "topic" else None
        if kind != "topic" and "type" in fields:
            self.problem(f"{path}.type", "a type is only for a topic")
        own = self.optional(fields, "within", path, duration_of)

        async def work(actions: Actions, within: float) -> None:
            bound = min(within, own) if own is not None else within
            if kind == "topic":
                await actions.wait_sample(str(name), str(type_), bound)
                return
            present = actions.service_present if kind == "service" else actions.node_present
            try:
                async with asyncio.timeout(bound):
                    while not await present(str(name)):  # noqa: ASYNC110 - the graph has no event for it
                        await asyncio.sleep(SETTLE)
            except TimeoutError:
                raise ProcedureFailed(f"{kind} {name} is not there within {bound:.3g} s") from None

        return work

    def _restore_state(self, fields: Mapping[str, Any], path: str) -> Work | None:
        only: list[str] | None = None
        if "only" in fields:
            only = fields["only"]
            if not isinstance(only, list) or not only or not all(_is_name(entry) for entry in only):
                self.problem(
                    f"{path}.only",
                    f"found {found_text(only)}; give a list of kept topics and nodes, such as [/amcl_pose]",
                )

        async def work(actions: Actions, within: float) -> None:
            await actions.restore_state(only, within)

        return work

    def _resend_goals(self, fields: Mapping[str, Any], path: str) -> Work | None:

        async def work(actions: Actions, within: float) -> None:
            await actions.resend_goals(within)

        return work

    # -- conditions -------------------------------------------------------------------------------------------------

    def _lifecycle_is(self, fields: Mapping[str, Any], path: str) -> Work | None:
        node, state = self._ros(fields, "node", path), self._state(fields, path)

        async def work(actions: Actions, within: float) -> None:
            found = await actions.lifecycle_state(str(node), within)
            if found != state:
                raise ProcedureFailed(f"node {node} is {found}, not {state}")

        return work

    def leaf(self, kind: str, fields: Mapping[str, Any], path: str) -> Work | None:
        """Return a function that evaluates a leaf of health trees; a procedure waits for it while it is starting."""
        try:
            tree: HealthTree = load({kind: fields}, path=path)
        except TreeError as error:
            self.problems += error.problems
            return None
        self.topics += tree.topics
        waits = self._waits

        async def work(actions: Actions, within: float) -> None:
            verdict = actions.health(tree)
            while waits and verdict.state == "Starting":
                await asyncio.sleep(SETTLE)
                verdict = actions.health(tree)
            if verdict.state != "Healthy":
                raise ProcedureFailed(verdict.reason)

        return work

    def _node_present(self, fields: Mapping[str, Any], path: str) -> Work | None:
        node = self._ros(fields, "node", path)

        async def work(actions: Actions, within: float) -> None:
            if not await actions.node_present(str(node)):
                raise ProcedureFailed(f"node {node} is not there")

        return work

    def _service_present(self, fields: Mapping[str, Any], path: str) -> Work | None:
        service = self._ros(fields, "service", path)

        async def work(actions: Actions, within: float) -> None:
            if not await actions.service_present(str(service)):
                raise ProcedureFailed(f"service {service} is not there")

        return work

    def _parameter_is(self, fields: Mapping[str, Any], path: str) -> Work | None:
        node, name = self._ros(fields, "node", path), fields.get("name")
        if not isinstance(name, str) or not name:
            self.problem(f"{path}.name", f"found {found_text(name)}; give the parameter's name")
        if "value" not in fields:
            self.problem(f"{path}.value", "missing; give the value that it must have")
        value = fields.get("value")

        async def work(actions: Actions, within: float) -> None:
            found = (await actions.get_parameters(str(node), [str(name)], within))[str(name)]
            if found != value:
                raise ProcedureFailed(f"parameter {name} of node {node} is {found!r:.100}, not {value!r:.100}")

        return work

    # -- fields -----------------------------------------------------------------------------------------------------

    def _ros(self, fields: Mapping[str, Any], key: str, path: str) -> str | None:
        if key not in fields:
            self.problem(f"{path}.{key}", f"missing; give the {key}'s fully qualified name, such as /{_EXAMPLES[key]}")
        name: str | None = self.optional(fields, key, path, name_of(key, f"/{_EXAMPLES[key]}"))
        return name

    def _type(self, fields: Mapping[str, Any], path: str, kind: str) -> str | None:
        right = f"package/{kind}/Name, such as {_TYPES[kind]}"
        if "type" not in fields:
            self.problem(f"{path}.type", f"missing; give {right}")
        type_: str | None = self.optional(fields, "type", path, type_of(kind, right))
        return type_

    def _state(self, fields: Mapping[str, Any], path: str) -> str | None:
        state = fields.get("state")
        if state not in STATES:
            self.problem(f"{path}.state", f"found {found_text(state)}; give one of {', '.join(STATES)}")
            return None
        return str(state)

    def _mapping(self, fields: Mapping[str, Any], key: str, path: str) -> Mapping[str, Any]:
        value = fields.get(key, {})
        if not isinstance(value, Mapping):
            self.problem(f"{path}.{key}", f"found {found_text(value)}; {key} is a mapping of fields")
            return {}
        return value


def _is_name(value: object) -> bool:
    return isinstance(value, str) and value.startswith("/") and len(value) > 1


def _mismatch(found: Mapping[str, Any], expected: Mapping[str, Any], *, path: str = "") -> str | None:
    """Return the first expected field that differs, in words; None if all match. Fields that are not named may have any value."""
    for field, value in expected.items():
        place = f"{path}.{field}" if path else str(field)
        if field not in found:
            return f"there is no field {place}; there are {', '.join(found)}"
        present = found[field]
        if isinstance(value, Mapping) and isinstance(present, Mapping):
            if (reason := _mismatch(present, value, path=place)) is not None:
                return reason
        elif present != value:
            return f"{place} is {present!r:.100}, expected {value!r:.100}"
    return None
