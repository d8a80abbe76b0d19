"""The memory limit of a monitor, by how much its policy lets it keep."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.api.conditions import Condition, condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.quantities import amount, binary_quantity
from understudy.controller.plan import Images
from understudy.kube.client import Object

CONDITION = "MemorySufficient"
"""The condition of a workload whose policy lets the monitor keep so much that it needs a higher limit than others."""


@dataclass(frozen=True)
class MonitorMemory:
    """The memory limit of a monitor that has no resources of its own."""

    limit: str
    """Empty for none."""
    needed: str = ""
    """The limit that the policy needs; empty if the usual one suffices."""

    @property
    def sufficient(self) -> bool:
        """Whether the kernel lets the monitor keep all that its policy allows."""
        return not self.needed or amount(self.needed) <= amount(self.limit)


def memory(policy: FailurePolicySpec, images: Images) -> MonitorMemory:
    """Return the memory limit of a monitor with this policy.

    It is higher than the usual one if the policy lets the monitor keep half of that or more. Authors of policies may be strangers
    to the cluster's administrator, so there is a maximum.
    """
    if not images.memory_limit:
        return MonitorMemory("")
    usual = amount(images.memory_limit)
    recorded = policy.black_box.memory_bytes if policy.black_box is not None else 0
    # A state is in memory twice while it is sent to an agent.
    kept = recorded + 2 * policy.state.max_bytes
    if kept < usual / 2:
        return MonitorMemory(images.memory_limit)
    needed = binary_quantity(usual + kept)
    return MonitorMemory(min(needed, maximum(images), key=amount), needed)


def maximum(images: Images) -> str:
    """Return the highest memory limit that a policy can give a monitor. It is not lower than the usual limit."""
    return max(images.memory_limit, images.max_memory_limit, key=amount)


def unchanged(deployment: Object | None, images: Images) -> MonitorMemory:
    """Return the limit while there is no valid policy: that of the monitor's Deployment, but at most the maximum."""
    if not images.memory_limit or deployment is None:
        return MonitorMemory(images.memory_limit)
    resources = deployment["spec"]["template"]["spec"]["containers"][0].get("resources") or {}
    present = (resources.get("limits") or {}).get("memory")
    return MonitorMemory(min(present or maximum(images), maximum(images), key=amount))


def judged(found: MonitorMemory, name: str, policy: FailurePolicySpec) -> list[Condition]:
    """Return the condition for a policy of this name; none if the usual limit suffices."""
    if not found.needed:
        return []
    if found.sufficient:
        words = f"The monitor's memory limit is {found.limit}, so that it can keep what FailurePolicy {name} allows."
        return [condition(CONDITION, True, "LimitRaised", words)]
    state = f"{policy.state.max_bytes} bytes of state (spec.state.maxBytes)"
    kept = f"{policy.black_box.memory} of messages (spec.blackBox.memory) and {state}" if policy.black_box else state
    words = (
        f"FailurePolicy {name} lets the monitor keep {kept}, which needs a memory limit of {found.needed}. The limit is {found.limit}, the "
        "highest that a policy can get (monitors.maxMemoryLimit of the chart). If the monitor uses more, it is killed and starts again. "
        "Reduce these fields, have the maximum raised, or set spec.monitor.resources of the RobotWorkload"
    )
    return [condition(CONDITION, False, "MaximumExceeded", words)]
