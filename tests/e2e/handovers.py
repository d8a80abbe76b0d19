"""A robot whose instance fails while it still sends, and whose standby runs on another node.

Only then the robot shows what a handover does: an instance that is silent already shows nothing of its gate.
"""

from __future__ import annotations

from tests.e2e.kubectl import Object
from tests.e2e.scenario import READINESS_PROBE, Robot, manifest, patient

_APART = "handovers.example/apart"
"""A label of all pods that are on different nodes."""


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
        # No instance is on the node of the other one, or of the robot. There is one term for both: older schedulers try a pod again only if
        # the pod that was deleted matches every term (kubernetes/kubernetes#139161).
        workload["spec"]["template"]["metadata"].setdefault("labels", {})[_APART] = robot.name
        apart = {"topologyKey": "kubernetes.io/hostname", "labelSelector": {"matchLabels": {_APART: robot.name}}}
        pod["affinity"] = {"podAntiAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": [apart]}}

    policy, pool = patient(manifest("strategies/executing.yaml"))
    policy["spec"]["monitoring"]["yaml"]["parallel"].append({"pod": {"condition": "ContainersReady", "for": "500ms"}})
    policy["spec"]["strategies"][0]["handover"] = handover
    found = robot.objects(policy=policy["metadata"]["name"], edit=edit)
    of_robot = next(item for item in found if item["kind"] == "Deployment")
    of_robot["spec"]["template"]["metadata"]["labels"][_APART] = robot.name
    return [policy, pool, *found]
