"""A robot whose instance fails while it still sends, and whose standby runs on another node.

Only then the robot shows what a handover does: an instance that is silent already shows nothing of its gate.
"""

from __future__ import annotations

from tests.e2e.kubectl import Object
from tests.e2e.scenario import READINESS_PROBE, Robot, manifest, patient
from understudy.api import names

_HOSTNAME = "kubernetes.io/hostname"


def objects(robot: Robot, *, handover: str, hertz: int) -> list[Object]:
    """The robot, its workload with an executing standby, their policy and their pool. They need three nodes.

    Let the instance fail with ``robot.fail(pod, "unready")``.

    Args:
        handover: ``handover`` of the strategy.
        hertz: commands of each instance per second.
    """

    def edit(workload: Object) -> None:
        pod = workload["spec"]["template"]["spec"]
        [container] = pod["containers"]
        container["readinessProbe"] = READINESS_PROBE
        container["env"] = [{"name": "DRIVE_HERTZ", "value": str(hertz)}]
        # No instance is on the node of the other one, or of the robot.
        apart = [_without({names.WORKLOAD: robot.workload}), _without({"app": robot.name})]
        pod["affinity"] = {"podAntiAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": apart}}

    policy, pool = patient(manifest("strategies/executing.yaml"))
    policy["spec"]["monitoring"]["yaml"]["parallel"].append({"pod": {"condition": "ContainersReady", "for": "500ms"}})
    policy["spec"]["strategies"][0]["handover"] = handover
    return [policy, pool, *robot.objects(policy=policy["metadata"]["name"], edit=edit)]


def _without(labels: dict[str, str]) -> Object:
    """A term of an affinity: nodes without pods that have these labels."""
    return {"topologyKey": _HOSTNAME, "labelSelector": {"matchLabels": labels}}
