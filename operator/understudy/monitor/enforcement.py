"""Whether the cluster's network enforces the gate, judged from the probes that get through (api.names.PROBE_PORT)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from understudy.mitigation.interfaces import Instance

SETTLE = 3.0
"""Seconds after a commit (or the start of an instance) before probes are judged; agents probe once a second."""

SILENT = 5.0
"""Seconds without a probe of the instance in control before its way to the robot counts as blocked."""

Judgement = tuple[Literal["True", "False", "Unknown"], str, str]


def judge(
    instances: Sequence[Instance],
    active_uid: str,
    last: dict[str, float],
    *,
    now: float,
    since: float,
    admitted_uid: str = "",
) -> Judgement:
    """Status, reason and message of the condition GateEnforced.

    ``last`` has the time of the last probe of each pod, by UID; ``since`` is when the gate last changed, in Unix seconds;
    ``admitted_uid`` is that of a standby that it lets through too. Reason Admitted: there's nobody left to be seen held
    back, so what was seen before that one was let through still stands.
    """
    probing = [i for i in instances if i.has_agent and i.running and not i.terminating and not i.held]
    if now - since < SETTLE:
        return "Unknown", "Settling", "The gate has just changed."
    leaking = [
        i.name for i in probing if i.uid not in (active_uid, admitted_uid) and last.get(i.uid, 0.0) > since + SETTLE
    ]
    if leaking:
        return (
            "False",
            "NotEnforced",
            f"Packets of {', '.join(leaking)} reach gated ports although the gate doesn't name it: the cluster's "
            "network doesn't enforce NetworkPolicies for UDP with endPort. Two instances could drive the robot. "
            "Use a network plugin that does.",
        )
    active = next((i for i in probing if i.uid == active_uid), None)
    if active is None:
        return "Unknown", "NoProbe", "The pod in control has no agent, so nothing was tried."
    if now - max(last.get(active.uid, 0.0), since) > SILENT:
        return (
            "False",
            "Blocked",
            f"Packets of {active.name} don't reach gated ports although the gate names it: look for other "
            "NetworkPolicies that select it, or for a network that doesn't carry its traffic.",
        )
    if admitted_uid and all(i.uid in (active_uid, admitted_uid) for i in probing):
        return "Unknown", "Admitted", "The only standby is let through too, for the reflex."
    if len(probing) == 1:
        return "Unknown", "NoStandby", "Packets of the pod in control get through; there's no standby to see held back."
    return (
        "True",
        "SeenFromPackets",
        "Packets of the pod in control get through the gate, those of every standby don't.",
    )
