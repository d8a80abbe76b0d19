"""A workload that is healthy and not well: told, given more, handed over when it is idle, with a standby made ready for it.

Its output comes at 20 Hz, or at 5 Hz while the test has it be slow; healthy is any rate, and well is more than 7 Hz.
"""

from __future__ import annotations

import time

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import eventually
from tests.e2e.test_tasks import NAME, SUCCEEDED, Cell, container

SLOW = "/tmp/slow"
BEFORE, AFTER = "400m", "450m"


class Degrading(Cell):
    """A workload that can be made slow, and what its policy does about that."""

    gap = "4s"

    def __init__(self, kubectl: Kubectl, *actions: Object, standbys: int = 1) -> None:
        self._actions, self._standbys = list(actions), standbys
        super().__init__(kubectl, "Executing")

    def containers(self) -> list[Object]:
        app = container("serve", STEP="0.1", TALK="/cmd_vel", SLOW=SLOW)
        app["resources"] = {"requests": {"cpu": "50m"}, "limits": {"cpu": BEFORE}}
        return [app]

    def _protection(self, strategy: str) -> list[Object]:
        policy, pool = super()._protection(strategy)
        policy["spec"]["degraded"] = {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "rate": "> 7 Hz"}}, "debounce": "2s"},
            "clearAfter": "5s",
            "actions": self._actions,
        }
        pool["spec"]["perWorkload"] = self._standbys
        return [policy, pool]

    def slow(self, pod: str, so: bool = True) -> None:
        """Have the application in a pod be slow, or no longer."""
        self.kubectl("exec", pod, "-c", "app", "--", *(("touch", SLOW) if so else ("rm", SLOW)))

    def wait_well(self) -> str:
        """Wait until it is protected, and known to be well; the pod in control."""
        active = self.wait_protected()
        eventually(
            lambda: self.condition("Degraded").get("reason") == "Well" and self.status()["health"] == "Healthy",
            within=60,
            what="it is known to be well",
            note=self.describe,
        )
        return active

    def wait_degraded(self) -> Object:
        """Wait until it is degraded; what is said."""

        def degraded() -> Object | None:
            said = self.condition("Degraded")
            return said if said.get("status") == "True" and self.status()["health"] == "Degraded" else None

        found: Object = eventually(degraded, within=60, what="it is degraded", note=self.describe)
        return found

    def recoveries(self) -> list[Object]:
        """The recoveries so far, the newest first."""
        return self.status().get("recoveries") or []

    def resources(self, pod: str) -> Object:
        """What the kubelet says that the application has."""
        statuses = self.kubectl.get("pod", pod)["status"]["containerStatuses"]
        found: Object = next(one for one in statuses if one["name"] == "app")
        return found

    def said(self) -> set[str]:
        """The reasons of the workload's Events."""
        events = self.kubectl.list("events")
        return {event["reason"] for event in events if event["involvedObject"]["name"] == NAME}


@pytest.mark.long
@pytest.mark.shows("leaf/topic")
def test_a_degraded_workload_is_reported_and_resized_in_place_without_a_failover(kubectl: Kubectl) -> None:
    cell = Degrading(kubectl, {"resize": {"container": "app", "cpu": AFTER}})
    active = cell.wait_well()
    assert cell.resources(active)["resources"]["limits"]["cpu"] == BEFORE
    cell.slow(active)
    said = cell.wait_degraded()
    print(f"\n{said['message']}")
    assert "/cmd_vel at " in said["message"]
    assert "below 7 Hz" in said["message"]
    eventually(
        lambda: cell.resources(active)["resources"]["limits"]["cpu"] == AFTER,
        within=60,
        what="the application has more CPU",
        note=cell.describe,
    )
    eventually(
        lambda: cell.condition("Resized").get("status") == "True",
        within=60,
        what="that is told",
        note=cell.describe,
    )
    now = cell.resources(active)
    assert now["resources"]["requests"]["cpu"] == AFTER
    assert now["restartCount"] == 0, "in place"
    assert cell.condition("Healthy")["status"] == "True"

    cell.slow(active, so=False)
    assert cell.wait_well() == active
    assert cell.recoveries() == []
    eventually(lambda: not cell.condition("Resized"), within=30, what="nothing more is asked for", note=cell.describe)
    assert cell.resources(active)["resources"]["limits"]["cpu"] == AFTER, "what it has it keeps"
    eventually(lambda: {"Degraded", "WellAgain"} <= cell.said(), within=30, what="both are Events", note=cell.describe)


@pytest.mark.long
def test_a_degraded_workload_is_handed_over_only_while_it_is_idle(kubectl: Kubectl) -> None:
    cell = Degrading(kubectl, {"reschedule": {"after": "3s", "idleFor": "3s"}})
    first = cell.wait_well()
    client = cell.client("client", "200")  # twenty seconds of work
    client.wait("feedback", 90, index=0)
    cell.slow(first)
    cell.wait_degraded()
    eventually(
        lambda: "a goal of /goto is active" in cell.condition("Degraded")["message"],
        within=30,
        what="it says what it waits for",
        note=cell.describe,
    )

    def handed_over() -> Object | None:
        recoveries = cell.recoveries()
        assert not recoveries or client.said("ended"), "nobody is interrupted"
        return next((r for r in recoveries if r["result"] == "Recovered"), None)

    recovery = eventually(handed_over, within=180, what="it is handed over", note=cell.describe)
    assert client.wait("ended", 1, index=0)["status"] == SUCCEEDED
    assert recovery["planned"]
    assert recovery["reason"].startswith("degraded: /cmd_vel at ")
    assert (recovery["strategy"], recovery["fromPod"]) == ("Fallback/Executing", first)
    second = cell.wait_well()
    assert second == recovery["toPod"]
    assert len(cell.recoveries()) == 1
    assert "Rescheduling" in cell.said()


@pytest.mark.long
def test_a_standby_is_created_while_the_workload_is_degraded_and_takes_over(kubectl: Kubectl) -> None:
    cell = Degrading(kubectl, {"prewarm": {"poolRef": {"name": NAME}}}, standbys=0)
    first = cell.wait_well()
    assert cell.status()["strategy"] == "Restart"
    assert len(kubectl.list("pods", f"understudy.dev/workload={NAME}")) == 1
    cell.slow(first)
    cell.wait_degraded()
    eventually(
        lambda: cell.status().get("strategy") == "Executing",
        within=120,
        what="a standby is ready and the monitor counts on it",
        note=cell.describe,
    )
    time.sleep(2.5)  # the monitor updates what is not urgent once a second
    kubectl("delete", "pod", first, "--grace-period=0", "--force", "--wait=false")
    recovery = eventually(
        lambda: next((r for r in cell.recoveries() if r["result"] == "Recovered"), None),
        within=90,
        what="the standby takes over",
        note=cell.describe,
    )
    assert (recovery["strategy"], recovery["planned"]) == ("Fallback/Executing", False)
    assert cell.wait_well() == recovery["toPod"]


@pytest.mark.long
def test_the_standby_of_a_degraded_workload_is_deleted_once_it_is_healthy(kubectl: Kubectl) -> None:
    cell = Degrading(kubectl, {"prewarm": {"poolRef": {"name": NAME}}}, standbys=0)
    active = cell.wait_well()
    cell.slow(active)
    cell.wait_degraded()

    def instances() -> int:
        found = kubectl.list("pods", f"understudy.dev/workload={NAME}")
        return sum(not pod["metadata"].get("deletionTimestamp") for pod in found)

    eventually(lambda: instances() == 2, within=60, what="a standby is made", note=cell.describe)
    cell.slow(active, so=False)
    assert cell.wait_well() == active
    eventually(lambda: instances() == 1, within=60, what="it goes again", note=cell.describe)
    assert cell.recoveries() == []
