"""A critical task raises the readiness of a robot's standby for as long as it runs: what fails in it is recovered by that standby."""

from __future__ import annotations

import time

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import eventually
from tests.e2e.test_tasks import ACTION, NAME, SUCCEEDED, Cell, container

pytestmark = pytest.mark.long


class Carrying(Cell):
    """A workload that has no standby, and one that runs in full while it works on a goal."""

    gap = "4s"

    def __init__(self, kubectl: Kubectl) -> None:
        super().__init__(kubectl, "Executing")

    def containers(self) -> list[Object]:
        return [container("serve", STEP="0.2", TALK="/cmd_vel")]

    def _protection(self, strategy: str) -> list[Object]:
        policy, pool = super()._protection(strategy)
        raised = policy["spec"]["strategies"]
        policy["spec"]["strategies"] = [{"type": "Restart", "verifyWithin": "60s"}]
        policy["spec"]["situations"] = [
            {"name": "carrying", "when": {"task": {"action": ACTION}}, "clearAfter": "3s", "strategies": raised}
        ]
        return [policy, pool]

    def instances(self) -> list[str]:
        """The names of the workload's pods that aren't on their way out."""
        found = self.kubectl.list("pods", f"understudy.dev/workload={NAME}")
        return [pod["metadata"]["name"] for pod in found if not pod["metadata"].get("deletionTimestamp")]

    def covered(self) -> tuple[str, str]:
        """What the condition says."""
        found = self.condition("SituationCovered")
        return found.get("status", ""), found.get("reason", "")


def test_a_task_raises_the_readiness_of_the_standby_until_the_task_ends(
    kubectl: Kubectl,
) -> None:
    cell = Carrying(kubectl)
    first = cell.wait_protected()
    assert cell.instances() == [first]
    assert cell.status()["strategies"] == "Restart"
    eventually(lambda: cell.covered() == ("True", "NoSituation"), within=30, what="that is told", note=cell.describe)

    client = cell.client("client", "400")  # 80 s of work
    client.wait("feedback", 90, index=0)
    begun = time.monotonic()

    def raised() -> bool:
        assert cell.condition("Protected").get("status") == "True", cell.describe()
        return cell.covered() == ("True", "InForce") and cell.status()["strategy"] == "Executing"

    eventually(raised, within=120, what="the standby is raised", note=cell.describe)
    print(f"\nraised {time.monotonic() - begun:.1f} s after the first feedback")
    situation = cell.status()["situation"]
    assert (situation["name"], situation["reason"]) == ("carrying", f"a goal of {ACTION} is active")
    assert cell.status()["strategies"] == f"Executing ({NAME}), Restart"
    time.sleep(2.5)  # the monitor updates what is not urgent once a second

    kubectl("delete", "pod", first, "--grace-period=0", "--force", "--wait=false")

    def recovered() -> Object | None:
        found = cell.status().get("recoveries") or []
        return next((one for one in found if one["result"] == "Recovered"), None)

    recovery = eventually(recovered, within=90, what="the standby takes over", note=cell.describe)
    print(f"recovered by {recovery['strategy']} in {recovery.get('recoverySeconds')} s")
    assert recovery["strategy"] == "Fallback/Executing"
    assert recovery["fromPod"] == first

    def raised_again() -> bool:
        others = [name for name in cell.instances() if name != recovery["toPod"]]
        return len(others) == 1 and cell.status()["standby"] == "Executing (1/1)"

    eventually(raised_again, within=120, what="there is another standby", note=cell.describe)

    assert client.wait("ended", 240, index=0)["status"] == SUCCEEDED, "the goal outlives it"
    eventually(
        lambda: "situation" not in cell.status() and cell.covered() == ("True", "NoSituation"),
        within=60,
        what="the situation is over",
        note=cell.describe,
    )
    eventually(lambda: cell.instances() == [recovery["toPod"]], within=60, what="the standby goes", note=cell.describe)
    eventually(lambda: cell.status()["strategy"] == "Restart", within=30, what="that is told", note=cell.describe)
    assert cell.condition("Protected")["status"] == "True"
    assert len(cell.status()["recoveries"]) == 1
