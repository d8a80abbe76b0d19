"""Finds the gate kind of a workload, and the resources of the objects that form gates."""

from __future__ import annotations

import re
from importlib import import_module
from typing import get_args

from understudy.api.kinds.robot_workload import Gate
from understudy.kube.client import Object, Resource
from understudy.kube.gates import pool_pod_policies
from understudy.kube.gates.base import GateKind


def _gate(kind: str) -> GateKind:
    module = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind).lower()
    found: GateKind = import_module(f"understudy.kube.gates.kinds.{module}").GATE
    return found


_FIELD = Gate.model_fields["kind"]

KINDS: dict[str, GateKind] = {kind: _gate(kind) for kind in get_args(_FIELD.annotation)}
"""Every kind by the value of ``spec.gate.kind``."""

DEFAULT: GateKind = KINDS[_FIELD.default]

GATE_RESOURCES: tuple[Resource, ...] = tuple(dict.fromkeys(gate.resource for gate in KINDS.values()))
"""Resources of the gate objects of all kinds."""

FENCING_RESOURCES: tuple[Resource, ...] = tuple(dict.fromkeys([*GATE_RESOURCES, pool_pod_policies.RESOURCE]))
"""Resources of everything that keeps instances from a robot. The operator watches them."""


OBJECT_KINDS: dict[str, Resource] = {gate.object_kind: gate.resource for gate in KINDS.values()} | {
    pool_pod_policies.KIND: pool_pod_policies.RESOURCE
}
"""The same resources by the kind of their objects."""


def of(workload: Object) -> GateKind:
    """Return the gate kind of a RobotWorkload; the default if its spec cannot be read."""
    spec = workload.get("spec") or {}
    return KINDS.get((spec.get("gate") or {}).get("kind", ""), DEFAULT)
