"""A robot behind a mux: only the instance in control reaches it, although no network policy keeps the others away."""

from __future__ import annotations

from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, eventually, manifest, never, patient

MUX = "mux/"


def muxed(robot: Robot, policy: str) -> None:
    """Apply the quickstart with a mux."""
    robot.kubectl.apply(patient(manifest(f"strategies/{policy.removeprefix('quickstart-')}.yaml")))
    robot.kubectl.apply(robot.objects(policy=policy, workload="mux/robotworkload.yaml", robot="mux/robot.yaml"))


def test_a_standby_takes_over_through_the_mux(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    muxed(robot, "quickstart-executing")
    first = robot.wait_protected()
    enforced = robot.condition("GateEnforced")
    assert (enforced["status"], enforced["reason"]) == ("True", "ReportedByMux"), enforced
    assert first in enforced["message"]
    standbys = [pod for pod in robot.pods() if pod != first]
    assert standbys, "an executing standby publishes all the time"
    never([c for c in robot.log(tail=400).commands if c.source != first], "commands of a standby")
    robot.fail(first, "killed")
    recovery = robot.wait_recovered()
    assert recovery.strategy == "Fallback/Executing"
    handover = robot.log(tail=2000).handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    never(handover.early, "commands of the standby before the switch")
    assert handover.overlap == 0
    eventually(
        lambda: recovery.new in robot.condition("GateEnforced")["message"],
        within=30,
        what="the mux reports the new one",
    )
