"""The pure parts of ``scripts/bench handover``: what the log of a robot shows of a handover, the bars, and the objects that it applies."""

from __future__ import annotations

from pathlib import Path

import pytest
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import RobotLog

from bench.handover import Passage, bars, passage
from tests.e2e import handovers
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot
from tests.support.manifests import MODELS
from tests.unit.bench import robot_logs

PERIOD = 0.005
DECIDED = 10.0


def log(*parts: tuple[str, float, float]) -> RobotLog:
    return robot_logs.log(*parts, period=PERIOD)


def seen(*parts: tuple[str, float, float]) -> Passage | None:
    moments = {"decided": DECIDED}
    recovery = Recovered(1, "", "Recovered", "Fallback/Executing", "a", "b", 2, 0.1, {}, moments)
    return passage(log(*parts), recovery)


def test_the_gap_is_from_the_last_command_of_the_former_instance_to_the_first_of_the_next() -> None:
    assert seen(("a", 9.0, 10.01), ("b", 10.09, 11.0)) == Passage(pytest.approx(0.08), 0.0, 0)


def test_both_are_open_from_the_first_command_of_the_next_to_the_last_of_the_former_instance() -> None:
    assert seen(("a", 9.0, 10.02), ("b", 10.011, 11.0)) == Passage(0.0, pytest.approx(0.009), 0)


def test_commands_of_the_next_instance_before_the_decision_are_counted_apart() -> None:
    found = seen(("b", 9.5, 9.51), ("a", 9.0, 10.01), ("b", 10.09, 11.0))
    assert found == Passage(pytest.approx(0.08), 0.0, 3)


@pytest.mark.parametrize(
    "parts",
    [
        [("a", 9.0, 9.8), ("b", 10.01, 11.0)],  # the former instance had stopped before the decision
        [("b", 10.01, 11.0)],
        [("a", 9.0, 10.01)],
    ],
    ids=["silent before the decision", "no former instance", "no next instance"],
)
def test_a_handover_in_which_an_instance_did_not_send_is_left_out(parts: list[tuple[str, float, float]]) -> None:
    assert seen(*parts) is None


def test_both_are_never_open_if_the_gate_is_closed_first_and_the_gap_has_a_bar() -> None:
    found = bars("BreakBeforeMake", hertz=200)
    assert found["both open"] == {"max": 0.0}
    assert found["gap"] == {"p95": pytest.approx(60 + 2 * 15 + 30 + 5)}


def test_one_write_has_no_bar_but_for_a_standby_that_is_let_through_early() -> None:
    assert bars("Switch", hertz=200) == {"early commands": {"max": 0.0}}


@pytest.fixture
def objects(monkeypatch: pytest.MonkeyPatch) -> dict[str, Object]:
    monkeypatch.setattr("shutil.which", lambda program: program)
    robot = Robot(Kubectl(Path("kubeconfig"), "fleet"))
    return {item["kind"]: item for item in handovers.objects(robot, handover="BreakBeforeMake", hertz=200)}


def test_the_objects_are_valid(objects: dict[str, Object]) -> None:
    for kind in ("FailurePolicy", "FallbackPool", "RobotWorkload"):
        MODELS[kind].model_validate(objects[kind]["spec"])


def test_the_policy_hands_over_as_it_is_asked_and_fails_a_pod_that_is_not_ready(objects: dict[str, Object]) -> None:
    spec = objects["FailurePolicy"]["spec"]
    assert [strategy.get("handover") for strategy in spec["strategies"]] == ["BreakBeforeMake", None]
    assert {"pod": {"condition": "ContainersReady", "for": "500ms"}} in spec["monitoring"]["yaml"]["parallel"]


def test_the_instances_send_at_the_rate_and_run_on_nodes_of_their_own(objects: dict[str, Object]) -> None:
    pod = objects["RobotWorkload"]["spec"]["template"]["spec"]
    [container] = pod["containers"]
    assert container["env"] == [{"name": "DRIVE_HERTZ", "value": "200"}]
    assert container["readinessProbe"]["failureThreshold"] == 1
    [term] = pod["affinity"]["podAntiAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"]
    apart = term["labelSelector"]["matchLabels"].items()
    for kind in ("RobotWorkload", "Deployment"):
        assert apart <= objects[kind]["spec"]["template"]["metadata"]["labels"].items(), kind
