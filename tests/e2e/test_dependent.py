"""Localization, planning and control in three pods: whose failure is acted on, and what is done with the others after it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import SIGNAL, Robot, eventually

EXAMPLE = Path(__file__).parents[2] / "examples" / "dependent"
GAP = "2s"
"""A busy machine may keep an application from talking for a second; here one failure is looked at, and there should be no other."""


class Application(Robot):
    """One of the three."""

    def __init__(self, kubectl: Kubectl, part: str) -> None:
        super().__init__(kubectl)
        self.part, self.workload = part, f"robot-1-{part}"

    def signal(self, pod: str, number: str) -> None:
        module = f"understudy_quickstart.{self.part}"
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", number, module, container=self.part)

    def wait_healthy(self) -> str:
        """Wait until an instance is in control and healthy; the pod."""
        eventually(
            lambda: self.status().get("health") == "Healthy" and self.status().get("active"),
            within=120,
            what=f"{self.workload} is healthy",
            note=self.describe,
        )
        active: str = self.status()["active"]
        return active

    def follows(self) -> list[list[str]]:
        """After the recoveries of which others its own were, oldest first."""
        return [[one["name"] for one in entry.get("follows") or []] for entry in self.newest_last()]

    def newest_last(self) -> list[Object]:
        return list(reversed(self.status().get("recoveries") or []))


class Three:
    """The robot and its applications."""

    def __init__(self, kubectl: Kubectl, gate_kind: str) -> None:
        self.kubectl = kubectl
        folder = "mux" if gate_kind == "Mux" else "manifests"
        for file in ("manifests/policies", f"{folder}/robotworkloads", f"{folder}/robot"):
            found = [item for item in yaml.safe_load_all((EXAMPLE / f"{file}.yaml").read_text()) if item]
            for item in found:
                if item["kind"] == "FailurePolicy":
                    item["spec"]["monitoring"]["yaml"]["topic"]["gap"] = GAP
            kubectl.apply(found)
        self.localization, self.planning, self.control = (
            Application(kubectl, part) for part in ("localization", "planning", "control")
        )

    def wait_driven(self) -> dict[str, str]:
        """Wait until all three are healthy and the robot is driven; their pods."""
        pods = {one.part: one.wait_healthy() for one in (self.localization, self.planning)}
        return pods | {"control": self.control.wait_driven()}


@pytest.fixture
def three(kubectl: Kubectl, gate_kind: str) -> Three:
    found = Three(kubectl, gate_kind)
    found.wait_driven()
    for one in (found.planning, found.control):
        eventually(
            lambda one=one: one.condition("DependenciesResolved").get("status") == "True",
            within=30,
            what=f"the dependencies of {one.workload} are followed",
            note=one.describe,
        )
    return found


def test_a_failure_that_follows_from_an_upstream_failure_is_handled_after_it(three: Three) -> None:
    before = three.wait_driven()
    three.localization.fail(before["localization"], "frozen")
    eventually(
        lambda: three.planning.condition("DependencyFailed").get("status") == "True",
        within=30,
        what="planning's failure is held",
        note=three.planning.describe,
    )
    assert "robot-1-localization" in three.planning.condition("DependencyFailed")["message"]
    three.localization.wait_recovered(1)
    three.planning.wait_recovered(1)
    after = three.wait_driven()
    assert after["localization"] != before["localization"]
    assert (after["planning"], after["control"]) == (before["planning"], before["control"]), "nothing else was replaced"
    assert three.planning.follows() == [["robot-1-localization"]]
    assert [one["strategy"] for one in three.planning.newest_last()] == ["Reinitialize"]
    assert three.control.newest_last() == [], "what it lacked came back, and nothing is done after that"
    (first,), (second,) = three.localization.newest_last(), three.planning.newest_last()
    assert first["moments"]["verified"] < second["moments"]["detected"], "one after the other"
    assert three.planning.condition("DependencyFailed").get("status") != "True"


@pytest.mark.long
def test_a_workload_with_dependencies_is_recovered_from_its_own_failure(three: Three) -> None:
    before = three.wait_driven()
    three.planning.fail(before["planning"], "frozen")
    recovery = three.planning.wait_recovered(1)
    assert recovery.strategy == "Restart"
    after = three.wait_driven()
    assert after["planning"] != before["planning"]
    assert (after["localization"], after["control"]) == (before["localization"], before["control"])
    assert three.planning.follows() == [[]]
    assert three.localization.newest_last() == []
    assert three.control.newest_last() == []


@pytest.mark.long
def test_a_monitor_that_is_replaced_meanwhile_reacts_to_the_upstream_recovery_once(three: Three) -> None:
    before = three.wait_driven()
    three.localization.fail(before["localization"], "frozen")
    three.planning.replace_monitor()
    three.localization.wait_recovered(1)
    three.planning.wait_recovered(1)
    three.planning.replace_monitor()
    after = three.wait_driven()
    assert after["planning"] == before["planning"]
    assert three.planning.follows() == [["robot-1-localization"]]
