"""What a failure now would lead to, in words."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.inspect.explanation_lines import explained_lines, known
from tests.unit.controller import world
from understudy.api import names
from understudy.cli.common.robots import UNWATCHED
from understudy.cli.inspect.explanation import for_scripts, lines


def test_a_completely_protected_robot_is_explained() -> None:
    found = known(fleet.well())
    text = explained_lines(found)
    assert found.is_well
    assert_golden("explain", lines(found, columns=None, colours=False))
    health, control = text[""]
    assert health == "fleet/robot-17-navigation  Healthy"
    assert all(fact in control for fact in ("robot-17-navigation-x8v2m on node-1", "gate epoch 41", "recovery #3"))
    first, second, third, *_ = text["If it failed now"]
    assert first.startswith("✓ 1. Fallback from pool navigation-hot would run")
    assert "509 ms" in first
    assert second.startswith("✓ 2. Fallback from pool navigation-spare is next")
    assert "within 1s" in second
    assert third.startswith("✓ 3. Restart is next")
    assert "within 20s" in third
    assert "3.68 s" in third
    assert text["Missing"] == ["✓ Nothing: everything that the first strategy needs is available."]
    hot, standby, spare, other = text["Pools"]
    assert hot == "navigation-hot (Executing): 1 ready, 1 wanted"
    assert standby == "robot-17-navigation-w7h5k on node-2: ready"
    assert spare.startswith("navigation-spare (Uninitialized, shared): 3 of 4")
    assert other == "navigation-spare-z5j7d on node-3: not ready"


def test_the_size_of_an_automatically_sized_pool_is_explained() -> None:
    why = "12 robots requested a pod 6 times in 120 robot hours. So the pool keeps 3 pods."
    condition = {
        "type": "Sized",
        "status": "True",
        "reason": "Sized",
        "message": why,
        "lastTransitionTime": fleet.ago(60),
    }
    figures = {
        "needed": 3,
        "robots": 12,
        "failures": 6,
        "robotHours": 120,
        "failuresPerRobotHour": 0.058,
        "low": 0.027,
        "high": 0.098,
    }
    sizing = {"size": 3, "lastChange": fleet.ago(60), **figures}
    pool = fleet.spare(size={"sizing": {"risk": "1%", "max": 9}}, sizing=sizing, conditions=[condition])
    item = fleet.well()
    others = [one for one in fleet.around(item) if one["metadata"]["name"] != "navigation-spare"]
    text = explained_lines(known(item, [*others, pool]))["Pools"]
    assert_golden("explain", text)
    assert text[2].startswith("navigation-spare (Uninitialized, shared): 3 of 3")
    assert text[3] == why


def test_an_unavailable_strategy_is_reported_with_a_cure_and_the_alternative() -> None:
    item = fleet.unprotected()
    found = known(item, fleet.around(item, standby_waits="ImagePullBackOff"))
    text = explained_lines(found)
    assert not found.is_well
    assert_golden("explain", [*text["If it failed now"], *text["Pools"], *text["Missing"]])
    first, second, *_ = text["If it failed now"]
    assert first.startswith("✗ 1. Fallback from pool navigation-hot")
    assert "(ImagePullBackOff)" in first
    assert "imagePullSecrets" in first
    assert second.startswith("✓ 2. Fallback from pool navigation-spare")
    (standby,) = (line for line in text["Pools"] if line.startswith("robot-19-navigation-w7h5k on node-2"))
    assert standby.endswith("(ImagePullBackOff)")
    (missing,) = text["Missing"]
    assert missing.startswith("✗ not protected (ImagePullBackOff, 3m12s)")


def test_the_reason_and_duration_of_a_degraded_state_are_explained() -> None:
    head, why, tree, _ = explained_lines(known(fleet.degraded()))[""]
    assert_golden("explain", [head, why, tree])
    assert tree.endswith("understudy tree -n fleet robot-18-navigation")
    assert head == "fleet/robot-18-navigation  Degraded for 38s"
    assert all(fact in why for fact in ("/scan", "8.6 Hz", "9.0 to 11.0", "sensors/scan"))
    missing = explained_lines(known(fleet.degraded()))["Missing"]
    assert missing[-1] == "✓ Nothing else: everything that the first strategy needs is available."


def test_a_missing_monitor_is_reported() -> None:
    item = fleet.unwatched()
    found = known(item, [i for i in fleet.around(item) if "monitor" not in i["metadata"]["name"]])
    text = explained_lines(found)
    assert not found.is_well
    assert text[""][0] == "fleet/robot-20-navigation  Unwatched"
    assert text["If it failed now"][0].startswith(
        "✗ Until the monitor runs (see Missing), a failure is neither detected"
    )
    assert_golden("explain", [text["If it failed now"][0], text["Missing"][0]])
    assert text["Missing"][0].startswith("✗ not protected (MonitorNotReady, 9s)")


def test_the_cluster_overrides_an_outdated_status() -> None:
    item = fleet.well()
    items = [i for i in fleet.around(item) if i["metadata"]["name"] != "robot-17-navigation-w7h5k"]
    found = known(item, items)
    assert not found.is_well
    (missing,) = explained_lines(found)["Missing"]
    assert_golden("explain", missing)
    assert missing.startswith("✗ not protected (StandbyNotReady)")


def test_a_monitor_that_expects_another_strategy_is_reported() -> None:
    item = fleet.well()
    item["status"]["strategy"] = "Restart"
    assert any(
        line.startswith("! The monitor reports a different next strategy: Restart.")
        for line in explained_lines(known(item))["If it failed now"]
    )
    assert not any(
        "different next strategy" in line for line in explained_lines(known(fleet.well()))["If it failed now"]
    )


def test_a_takeover_by_the_reflex_counts_for_its_strategy() -> None:
    item = fleet.well()
    for recovery in item["status"]["recoveries"]:
        recovery["strategy"] = "Fallback/Executing (reflex)"
    assert explained_lines(known(item))["If it failed now"][0].endswith(
        "It took 509 ms, the median of the last 3 times."
    )


def test_a_missing_active_instance_is_reported() -> None:
    item = fleet.well()
    gate = world.gate(item, epoch=42)
    others = [i for i in fleet.around(item) if i["kind"] != "NetworkPolicy"]
    assert "In control: nobody (gate epoch 42)." in explained_lines(known(item, [*others, gate]))[""]


def test_a_missing_policy_is_reported() -> None:
    item = fleet.well()
    found = known(item, [i for i in fleet.around(item) if i["kind"] != "FailurePolicy"])
    text = explained_lines(found)
    assert_golden("explain", text["If it failed now"])
    assert 'FailurePolicy "navigation" in namespace fleet' in text["If it failed now"][0]
    assert "Executing" in text["If it failed now"][1]
    assert "Not covered" not in text


def test_a_pool_that_does_not_serve_the_workload_is_reported() -> None:
    item = fleet.well()
    item["metadata"]["labels"] = {"app": "navigation"}
    text = explained_lines(known(item))
    first = text["If it failed now"][0]
    assert_golden("explain", first)
    assert first.startswith("✗ 1. Fallback from pool navigation-hot")
    assert "(PoolDoesNotServe)" in first
    assert not any(line.startswith("navigation-hot") for line in text["Pools"])


def test_a_pool_with_too_few_pods_is_reported_unless_the_cause_is() -> None:
    item = fleet.unprotected()
    others = [i for i in fleet.around(item, standby_waits="ImagePullBackOff") if i["kind"] != "FallbackPool"]
    text = explained_lines(known(item, [*others, fleet.short_of_one(), fleet.short_of_another()]))
    assert_golden("explain", text["Missing"])
    (short,) = text["Missing"][1:]
    assert short.startswith("✗ pool navigation-spare")
    assert all(fact in short for fact in ("(PodsNotReady)", "3 of 4"))


def test_a_policy_without_an_available_strategy_is_reported() -> None:
    item = fleet.well()
    policy = fleet.policy({"type": "Fallback", "poolRef": {"name": "elsewhere"}})
    others = [i for i in fleet.around(item) if i["kind"] != "FailurePolicy"]
    text = explained_lines(known(item, [*others, policy]))
    assert_golden("explain", [*text["If it failed now"], *text["Not covered"]])
    assert any(line.startswith("✗ No strategy of its policy") for line in text["If it failed now"])
    assert any("one strategy" in line for line in text["Not covered"])


def test_gaps_in_the_configured_protection_are_listed() -> None:
    item = fleet.workload(
        "robot-17-navigation",
        status=fleet.status("robot-17-navigation", "x8v2m", 41),
        outputs=[
            {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},
            {"topic": "/gripper", "type": "std_msgs/msg/Float64"},
            {"service": "/clear", "type": "std_srvs/srv/Trigger"},
        ],
    )
    first, *others = explained_lines(known(item))["Not covered"]
    assert_golden("explain", [first, *others])
    assert "does not watch /gripper" in first
    assert any("keeps no state" in line for line in others)
    assert any("no safe commands" in line for line in others)


@pytest.mark.parametrize(
    ("status", "reason", "told_first"),
    [
        ("Unknown", "NobodyReads", True),
        ("True", "ReadPastTheGate", True),
        ("True", "AtGatedPorts", False),
        ("False", "ReaderWithoutProfile", False),
    ],
)
def test_output_readers_are_reported_as_missing_only_if_the_condition_is_false(
    status: Any, reason: str, told_first: bool
) -> None:
    name, words = "robot-17-navigation", "Of /cmd_vel it is so."
    item = fleet.workload(
        name, status=fleet.status(name, "x8v2m", 41, fleet.condition("OutputsRead", status, reason, words))
    )
    text = explained_lines(known(item))
    assert (text["Not covered"][0] == words) is told_first
    assert any(words in line for line in text["Missing"]) is (status == "False")


def test_a_pool_with_standbys_only_while_degraded_is_left_out_and_reported() -> None:
    item = fleet.well()
    warm = {
        "degraded": {
            "monitoring": {"yaml": fleet.TREE},
            "actions": [{"prewarm": {"poolRef": {"name": "navigation-hot"}}}],
        }
    }
    cold = fleet.hot()
    cold["spec"]["perWorkload"] = 0
    others = [
        i for i in fleet.around(item) if i["kind"] != "FailurePolicy" and i["metadata"]["name"] != "navigation-hot"
    ]
    text = explained_lines(known(item, [*others, fleet.policy(**warm), cold]))
    assert_golden("explain", text["If it failed now"])
    assert text["If it failed now"][0].startswith("✓ 1. Fallback from pool navigation-spare")
    assert any(line.startswith("Left out: navigation-hot") for line in text["If it failed now"])


def test_the_current_situation_and_its_strategies_are_explained() -> None:
    strategies = [{"type": "Fallback", "poolRef": {"name": "navigation-hot"}}, {"type": "Restart"}]
    carrying = {"name": "carrying", "when": {"task": {"action": "/carry"}}, "strategies": strategies}
    asked = fleet.policy({"type": "Restart"}, situations=[carrying])
    item = fleet.well()
    item["status"]["situation"] = {"name": "carrying", "since": fleet.ago(90), "reason": "a goal of /carry is active"}
    words = "The robot is in situation carrying. Strategies in effect: Executing (navigation-hot), Restart."
    item["status"]["conditions"].append(fleet.condition("SituationCovered", "True", "InForce", words).to_wire())
    text = explained_lines(known(item, [*(i for i in fleet.around(item) if i["kind"] != "FailurePolicy"), asked]))
    (situation,) = (line for line in text[""] if line.startswith("Situation: "))
    assert_golden("explain", situation)
    assert all(fact in situation for fact in ("carrying for 1m30s", "a goal of /carry is active", words))
    assert text["If it failed now"][0].startswith("✓ 1. Fallback from pool navigation-hot would run")


def test_a_situation_whose_standby_is_not_ready_is_listed_as_missing() -> None:
    item = fleet.well()
    words = "The robot is in situation carrying. Until its first strategy is available, the strategies stay Restart."
    item["status"]["conditions"].append(
        fleet.condition("SituationCovered", "False", "StandbyNotReady", words).to_wire()
    )
    (missing,) = (line for line in explained_lines(known(item))["Missing"] if words in line)
    assert_golden("explain", missing)
    assert "(StandbyNotReady, 4m12s)" in missing


def test_only_the_newest_warning_events_are_shown() -> None:
    events = [
        fleet.event(900, "StandbyReplaced", "w-1 was ready"),
        fleet.event(30, "GateBlocked", "Packets of w-2", count=3),
        fleet.event(10, "Recovered", "all well", kind="Normal"),
    ]
    assert explained_lines(known(fleet.well(), None, *events))["Lately"] == [
        "30s ago  GateBlocked, 3 times: Packets of w-2",
        "15m ago  StandbyReplaced: w-1 was ready",
    ]


@pytest.mark.parametrize("columns", [60, 80, 140])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    item = fleet.unprotected()
    found = known(item, fleet.around(item, standby_waits="ImagePullBackOff"))
    assert max(len(line) for line in lines(found, columns=columns, colours=False)) <= columns


def test_dependencies_and_dependents_are_listed() -> None:
    needs = [{"name": "localization"}, {"name": "maps", "onRecovery": "Restart"}]
    item = fleet.workload("planning", status=fleet.status("planning", "x8v2m", 4), dependsOn=needs)
    first = fleet.workload("localization", status=fleet.status("localization", "c5n8r", 2, health="Recovering"))
    last = fleet.workload("control", dependsOn=[{"name": "planning"}])
    text = explained_lines(known(item, [*fleet.around(item), item, first, last]))
    localization, maps, control = text["Dependencies"]
    assert_golden("explain", text["Dependencies"])
    assert localization.startswith("✗ depends on localization (Recovering).")
    assert maps.startswith("✗ depends on maps,")
    assert control.startswith("Workloads that depend on this one: control.")
    assert "Dependencies" not in explained_lines(known(fleet.well()))


def test_a_recovery_known_only_from_the_gate_is_explained() -> None:
    item = fleet.well()
    others = [one for one in fleet.around(item) if one["kind"] != "NetworkPolicy"]
    items = [*others, fleet.gate(item, fleet.under_way())]
    found = known(item, items)
    text, how = (
        explained_lines(found),
        "no /cmd_vel for 500 ms; Fallback/Executing is tried with robot-17-navigation-w7h5k.",
    )
    assert (found.health, found.is_well) == ("Recovering", False)
    assert text[""][:2] == ["fleet/robot-17-navigation  Recovering for 1s", how]
    assert_golden("explain", text[""])
    assert all(fact in text[""][-1] for fact in ("robot-17-navigation-w7h5k on node-2", "gate epoch 42"))
    assert text["Missing"] == [f"✗ recovering (FailureDetected, 1s): {how}"]
    assert for_scripts(found)["health"] == "Recovering"
    assert known(item, [one for one in items if "monitor" not in one["metadata"]["name"]]).health == UNWATCHED


def test_a_dependency_is_recovering_as_soon_as_its_gate_reports_it() -> None:
    needs = [{"name": "robot-17-navigation"}]
    item = fleet.workload("planning", status=fleet.status("planning", "x8v2m", 4), dependsOn=needs)
    first = fleet.well()
    around = [*fleet.around(item), first]
    assert explained_lines(known(item, around))["Dependencies"][0].startswith(
        "✓ depends on robot-17-navigation (Healthy)."
    )
    around.append(fleet.gate(first, fleet.under_way()))
    assert explained_lines(known(item, around))["Dependencies"][0].startswith(
        "✗ depends on robot-17-navigation (Recovering)."
    )


def test_a_robot_with_a_mux_is_explained_by_its_mux() -> None:
    outputs = [
        {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},
        {"service": "/dock", "type": "std_srvs/srv/Trigger"},
    ]
    item = fleet.muxed(outputs=outputs, gate={"kind": "Mux", "reflex": {"deadline": "200ms"}})
    items = fleet.around(item)
    (gate,) = (one for one in items if one["kind"] == "Lease")
    gate["metadata"]["annotations"][names.ADMITTED] = "robot-17-navigation-w7h5k"
    text = explained_lines(known(item, items))
    (admitted,) = (line for line in text[""] if "w7h5k" in line)
    (switches,) = (line for line in text["If it failed now"] if "Lease" in line)
    (served,) = (line for line in text["Not covered"] if "/dock" in line)
    assert_golden("explain", [admitted, switches, served])
    assert "the mux switches to standby" in admitted
    assert not any("NetworkPolicy" in line for lines in text.values() for line in lines)
