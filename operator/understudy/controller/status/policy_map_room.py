"""The condition of a workload whose gate needs nearly all of Cilium's policy map, or more than all."""

from __future__ import annotations

from understudy.api.conditions import Condition, condition
from understudy.kube.client import Object
from understudy.kube.gates import cilium
from understudy.kube.gates.cilium import PolicyMapUse

CONDITION = "PolicyMapSufficient"


def conditions(use: PolicyMapUse | None) -> list[Condition]:
    """Return the condition; none if there is enough room, or if that is not known."""
    if use is None or not use.is_low:
        return []
    settings = use.settings
    assumed = f" (assumed, because {settings.doubt})" if settings.doubt else ""
    needed = (
        f"An instance needs {use.percent} % of the {settings.entries} entries{assumed} of its policy map in Cilium, and each further pod "
        f"of its peers needs {use.each}"
    )
    cure = f"{cilium.MORE_ROOM[0].upper()}{cilium.MORE_ROOM[1:]}"
    reason, limit = "PolicyMapNearlyFull", "Beyond the limit, "
    if use.is_exceeded:
        reason, limit = "PolicyMapFull", "This is beyond the limit: "
    return [condition(CONDITION, False, reason, f"{needed}. {limit}{use.consequence}. {cure}")]


def is_reported(workload: Object) -> bool:
    """Whether the status of a workload has the condition."""
    found = (workload.get("status") or {}).get("conditions") or []
    return any(one["type"] == CONDITION for one in found)
