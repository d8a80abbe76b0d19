"""The judge of a campaign, on logs whose faults are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Command

from bench.chaos.judge import Commit, Injected, Judgement, Seen, covered, judge
from bench.chaos.plan import BY_NAME, Fault

PERIOD = 0.05
TIMEOUT = 0.5


def drive(source: str, begin: float, end: float, *, age: float = 0.002) -> list[Command]:
    """Commands of a pod at every period, which were sent so many seconds before."""
    moments = [begin + PERIOD * n for n in range(round((end - begin) / PERIOD) + 1)]
    return [Command(at, source, 0, at - age, 0.2, 0.0, 0.0, 0.0, 0.0, 0.2) for at in moments]


def log(*parts: list[Command]) -> list[Command]:
    """All of it in the order of reception, with sequence numbers."""
    ordered = sorted((command for part in parts for command in part), key=lambda c: c.received)
    return [Command(c.received, c.source, n, c.sent, *[0.0] * 6) for n, c in enumerate(ordered, 1)]


def fault(kind: str, begun: float, ended: float | None = None, *, robot: int = 0, number: int = 1) -> Injected:
    made = Fault(number, kind, begun, (ended or begun) - begun, robot, "active", 0, 0.5)
    return Injected(made, begun, begun if ended is None else ended)


def recovery(
    detected: float,
    routed: float,
    strategy: str = "Fallback/Executing",
    reason: str = "",
    failed: Sequence[str] = (),
    last_healthy: float | None = None,
) -> Recovered:
    moments = {"detected": detected, "decided": detected, "fenced": routed, "routed": routed}
    moments |= {"lastHealthy": last_healthy} if last_healthy is not None else {}
    tried = [
        *({"strategy": name, "result": "NotVerified"} for name in failed),
        {"strategy": strategy, "result": "Verified"},
    ]
    return Recovered(1, reason, "Recovered", strategy, "a", "b", 2, routed - detected, {}, moments, tried)


def judged(commands: Sequence[Command], *injected: Injected, **more: Any) -> Judgement:
    commits = more.pop("commits", [Commit(0.0, 1, ("a",)), Commit(10.6, 2, ("b",))])
    seen = Seen("robot-1", 0, TIMEOUT, commands=commands, commits=commits, **more)
    return judge(seen, injected, PERIOD)


def whats(found: Judgement) -> list[str]:
    return [violation.what for violation in found.violations]


KILLED = fault("kill", 10.02)


@pytest.mark.parametrize(
    ("last", "api_back", "expected"),
    [(34.0, None, []), (38.0, None, ["double drive", "fenced instance"]), (38.0, 37.0, [])],
)
def test_an_instance_on_a_node_that_was_cut_may_drive_until_its_network_has_caught_up(
    last: float, api_back: float | None, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.6, 50), drive("a", 30.01, last))
    faults = [replace(fault("node-cut", 10.02, 30.0), told="n3")]
    faults += [fault("api-flap", 28.0, api_back, robot=-1, number=2)] if api_back else []
    found = judged(commands, *faults, recoveries=[recovery(10.5, 10.6)], nodes={"a": "n3", "b": "n2"})
    assert sorted(set(whats(found))) == expected


@pytest.mark.parametrize(
    ("begun", "last", "expected"),
    [(10.0, 11.8, []), (10.0, 21.0, ["fenced instance"]), (13.0, 11.8, ["fenced instance"])],
)
def test_a_fenced_instance_may_drive_alone_while_the_api_server_fails_so_that_no_node_learns_of_the_fence(
    begun: float, last: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, last), drive("b", last + 0.5, 30))
    flap = fault("api-flap", begun, begun + 5.0, robot=-1, number=2)
    found = judged(commands, KILLED, flap, recoveries=[recovery(10.5, 10.6)])
    assert [what for what in whats(found) if what == "fenced instance"] == expected


@pytest.mark.parametrize(("age", "expected"), [(0.075, []), (0.01, ["fenced instance"])])
def test_a_command_may_be_under_way_while_its_instance_is_fenced(age: float, expected: list[str]) -> None:
    late = drive("a", 10.67, 10.67, age=age)
    found = judged(log(drive("a", 1, 10), late, drive("b", 10.7, 20)), KILLED, recoveries=[recovery(10.5, 10.6)])
    assert [what for what in whats(found) if what == "fenced instance"] == expected


def test_the_gate_may_be_closed_for_a_while_if_the_network_of_a_node_that_returned_lets_a_fenced_instance_through() -> (
    None
):
    cut = replace(fault("node-cut", 10.02, 45.0), told="n3")

    def found(leak: list[Command]) -> list[str]:
        commands = log(drive("a", 1, 10), drive("b", 10.6, 46.2), leak, drive("b", 52.0, 60))
        return whats(judged(commands, cut, recoveries=[recovery(10.5, 10.6)], nodes={"a": "n3", "b": "n2"}))

    assert found(drive("a", 46.01, 46.1)) == []
    assert found([]) == ["gap"]


def test_the_gate_may_be_closed_for_an_instance_on_a_returned_node_that_only_test_packets_reach_the_monitor_from() -> (
    None
):
    cut = replace(fault("node-cut", 10.02, 45.0), told="n3")
    commands = log(drive("a", 1, 10), drive("b", 10.6, 46.2), drive("b", 52.0, 60))
    commits = [Commit(0.0, 1, ("a",)), Commit(10.6, 2, ("b",)), Commit(46.3, 3, ()), Commit(51.9, 4, ("b",))]

    def found(node: str) -> list[str]:
        nodes = {"a": node, "b": "n2"}
        return whats(judged(commands, cut, commits=commits, recoveries=[recovery(10.5, 10.6)], nodes=nodes))

    assert found("n3") == []
    assert found("n1") == ["gap"]


def test_a_clean_handover_of_a_killed_instance_has_no_violation() -> None:
    found = judged(log(drive("a", 1, 10), drive("b", 10.61, 20)), KILLED, recoveries=[recovery(10.5, 10.6)])
    assert whats(found) == []
    assert found.gaps == {"Fallback/Executing": [pytest.approx(0.61)]}
    assert found.recoveries == {"Fallback/Executing": 1}


def test_two_instances_that_take_turns_drive_together_and_one_of_them_is_fenced() -> None:
    found = judged(log(drive("a", 1, 12), drive("b", 10.62, 20)), KILLED, recoveries=[recovery(10.5, 10.6)])
    assert found.double_drives == [pytest.approx(1.4, abs=0.1)]
    assert max(found.fenced) == pytest.approx(1.4)
    assert whats(found) == ["double drive", "fenced instance"]
    assert {violation.faults for violation in found.violations} == {(1,)}


def test_an_instance_that_returns_later_is_fenced_but_does_not_drive_together_with_the_other() -> None:
    found = judged(log(drive("a", 1, 10), drive("b", 10.62, 14), drive("a", 17, 17)), KILLED)
    assert found.double_drives == []
    assert found.fenced == [pytest.approx(6.4)]


def test_the_reader_of_a_robot_with_a_reflex_may_go_back_until_the_commit() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.2, 10.4), drive("a", 10.41, 10.56), drive("b", 10.59, 20))
    commits = [Commit(0.0, 1, ("a", "b")), Commit(10.6, 2, ("b",))]
    assert whats(judged(commands, KILLED, commits=commits, reflex=0.3)) == []
    assert "double drive" in whats(judged(commands, KILLED, commits=commits))


def test_an_instance_that_was_never_let_through_is_a_stranger() -> None:
    found = judged(log(drive("a", 1, 10), drive("c", 5, 5.1), drive("b", 10.62, 20)), KILLED)
    assert found.strangers == 3
    assert whats(found) == ["double drive", "not in control"]


def test_what_tampering_lets_through_until_it_is_repaired_is_counted_apart() -> None:
    parts = drive("a", 1, 10), drive("c", 5, 5.6), drive("b", 10.62, 20)
    found = judged(log(*parts), KILLED, fault("label-remove", 4.8))
    assert whats(found) == []
    assert max(found.repaired) == pytest.approx(0.8)
    found = judged(log(*parts), KILLED, fault("label-remove", 3.0))
    assert whats(found) == ["double drive", "not in control"], "it took too long"


def test_commands_before_the_commit_was_seen_are_right_and_later_ones_are_late_by_the_enforcement() -> None:
    found = judged(log(drive("a", 1, 10.64), drive("b", 10.65, 20)), KILLED)
    assert found.fenced == []
    assert found.strangers == 0
    found = judged(log(drive("a", 1, 10), drive("b", 10.3, 20)), KILLED)
    assert found.strangers == 0, "the watch may be late"


def test_a_commit_that_the_watch_saw_late_was_made_when_its_recovery_says() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.61, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(11.5, 2, ("b",))]
    assert whats(judged(commands, KILLED, commits=commits)) == ["not in control"]
    assert whats(judged(commands, KILLED, commits=commits, recoveries=[recovery(10.5, 10.6)])) == []


def test_while_the_gate_was_not_watched_both_may_be_right() -> None:
    commits = [Commit(0.0, 1, ("a",)), Commit(30.0, 2, ("b",), since=8.0)]
    found = judged(log(drive("a", 1, 10), drive("b", 10.62, 40)), KILLED, commits=commits)
    assert "not in control" not in whats(found)
    assert "fenced instance" not in whats(found)


def test_commands_that_were_sent_before_the_switch_are_stale() -> None:
    burst = [Command(10.61, "b", 0, 10.61 - age, *[0.0] * 6) for age in (0.48, 0.2, 0.03)]
    found = judged(log(drive("a", 1, 10), burst, drive("b", 10.65, 20)), KILLED)
    assert found.stale == [pytest.approx(0.47), pytest.approx(0.19)]
    assert whats(found) == ["stale command"]


def test_a_command_that_tampering_let_through_and_the_robots_reader_held_is_counted_apart() -> None:
    early = replace(drive("b", 10.6, 10.7)[0], sent=3.0)
    commands = log(drive("a", 1, 10.5), [early], drive("b", 10.65, 12))
    more: Any = {"commits": [Commit(0.0, 1, ("a",)), Commit(10.55, 2, ("b",))], "recoveries": [recovery(10.5, 10.6)]}
    found = judged(commands, KILLED, fault("label-exchange", 2.8, number=2), **more)
    assert (found.held, found.stale) == ([pytest.approx(7.6, abs=0.1)], [])
    assert "stale command" in whats(judged(commands, KILLED, **more))


def test_commands_that_a_busy_robot_received_late_are_not_stale_if_the_gate_was_open_when_they_were_sent() -> None:
    burst = [Command(10.9, "b", 0, 10.9 - age, *[0.0] * 6) for age in (0.28, 0.2, 0.03)]
    commits = [Commit(0.0, 1, ("a",)), Commit(11.2, 2, ("b",))]
    commands = log(drive("a", 1, 10), burst, drive("b", 10.95, 20))
    assert judged(commands, KILLED, commits=commits, recoveries=[recovery(10.5, 10.6)]).stale == []
    assert judged(commands, KILLED, commits=commits).stale == [pytest.approx(0.28), pytest.approx(0.2)]


@pytest.mark.parametrize(("stall", "expected"), [(0.45, []), (0.7, ["stale command"])])
def test_the_last_command_before_a_stall_of_its_process_is_counted_apart(stall: float, expected: list[str]) -> None:
    late = [Command(10.9, "b", 0, 10.9 - stall, *[0.0] * 6)]
    found = judged(log(drive("a", 1, 10), late, drive("b", 10.95, 20)), KILLED)
    assert whats(found) == expected
    assert [*found.stalled, *found.stale] == [pytest.approx(stall - 0.3)]


def test_a_robot_whose_monitor_was_on_a_lost_node_waits_until_the_next_one_has_begun() -> None:
    commits = [Commit(0.0, 1, ("a",)), Commit(45.0, 2, ("b",))]
    commands = log(drive("a", 1, 10), drive("b", 45.05, 60))
    lost = replace(fault("node-power", 10.0, 20.0), told="n3")
    switched = recovery(44.5, 45.0)

    def found(*monitors: tuple[float, str]) -> Judgement:
        return judged(commands, lost, commits=commits, recoveries=[switched], monitors=monitors)

    elsewhere, same_node = ((0.5, "n2"), (39.5, "n2")), ((0.5, "n3"), (39.5, "n2"))
    assert whats(found(*elsewhere)) == ["gap"]
    assert whats(found(*same_node)) == []
    assert found(*same_node).unwatched == [pytest.approx(29.5)]


@pytest.mark.parametrize(("evictions", "expected"), [([11.5], []), ([], ["gap"]), ([2.0], ["gap"])])
def test_time_until_the_next_monitor_is_not_counted_if_kubernetes_evicted_the_last_one(
    evictions: list[float], expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 45, 50))
    commits = [Commit(0.0, 1, ("a",)), Commit(45.0, 2, ("b",))]
    more: dict[str, Any] = {"commits": commits, "recoveries": [recovery(44.5, 45.0)], "unmonitored": [(10.5, 39.5)]}
    assert whats(judged(commands, KILLED, evictions=evictions, **more)) == expected


def test_a_gap_may_take_the_time_of_the_strategies_that_were_tried() -> None:
    commands = log(drive("a", 1, 10), drive("b", 15, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(15.0, 2, ("b",))]
    hot, cold = recovery(10.5, 15.0), recovery(10.5, 15.0, "Restart")
    assert whats(judged(commands, KILLED, commits=commits, recoveries=[hot])) == ["gap"]
    assert whats(judged(commands, KILLED, commits=commits, recoveries=[cold])) == []
    second = recovery(10.5, 15.0, failed=["Fallback/Initialized"])
    assert whats(judged(commands, KILLED, commits=commits, recoveries=[second])) == []
    assert whats(judged(commands, KILLED, commits=commits)) == ["gap"], "nobody recovered it"


@pytest.mark.parametrize(
    ("strategy", "drove", "expected"),
    [("Restart", 0.75, []), ("Restart", 3.5, ["gap"]), ("Fallback/Executing", 0.75, ["gap"])],
)
def test_an_instance_that_fails_as_soon_as_the_last_strategy_activated_it_is_waited_for(
    strategy: str, drove: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 12, 12 + drove), drive("b", 12 + drove + 2.65, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(12.0, 2, ("b",))]
    recovered = recovery(10.5, 12.0, strategy, failed=["Restart"])
    frozen = fault("freeze", 12 + drove, 12 + drove + 2.65, number=2)
    assert whats(judged(commands, KILLED, frozen, commits=commits, recoveries=[recovered])) == expected


def test_time_without_a_monitor_or_an_api_server_is_not_counted() -> None:
    commands = log(drive("a", 1, 10), drive("b", 15, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(15.0, 2, ("b",))]
    away = fault("api-stop", 9.0, 14.5, robot=3)
    found = judged(commands, KILLED, away, commits=commits, recoveries=[recovery(10.5, 15.0)])
    assert whats(found) == []
    other = fault("monitor-freeze", 9.0, 14.5, robot=3)
    assert whats(judged(commands, KILLED, other, commits=commits, recoveries=[recovery(10.5, 15.0)])) == ["gap"]


def test_a_lost_node_is_waited_for_only_until_its_monitors_are_replaced_elsewhere() -> None:
    commands = log(drive("a", 1, 10), drive("b", 45, 50))
    commits = [Commit(0.0, 1, ("a",)), Commit(45.0, 2, ("b",))]
    lost = fault("node-power", 10.0, 40.0)
    found = judged(commands, lost, commits=commits, recoveries=[recovery(44.5, 45.0)])
    assert whats(found) == ["gap"]
    assert found.gaps == {"Fallback/Executing": [pytest.approx(15.0)]}


def test_a_failover_is_false_if_the_robot_had_its_commands_and_no_fault_disturbed_them() -> None:
    commands, recoveries = log(drive("a", 1, 10.55), drive("b", 10.62, 20)), [recovery(10.5, 10.6)]
    assert whats(judged(commands, fault("monitor-freeze", 8.0, 9.0), recoveries=recoveries)) == ["false failover"]
    assert whats(judged(commands, KILLED, recoveries=recoveries)) == []
    reflex = [recovery(10.5, 10.6, "Fallback/Executing (reflex)")]
    early = judged(log(drive("a", 1, 10.2), drive("b", 10.5, 20)), recoveries=reflex, reflex=0.3)
    assert (early.unexplained, "false failover" in whats(early)) == (1, False), "a reflex is faster than the timeout"
    late = judged(log(drive("a", 1, 10.31), drive("b", 10.62, 20)), recoveries=reflex, reflex=0.3)
    assert "false failover" not in whats(late), "the robot's reader switched, after the monitor's had"
    silent = judged(log(drive("a", 1, 10), drive("b", 10.62, 20)), recoveries=recoveries)
    assert silent.unexplained == 1
    assert whats(silent) == []


def test_a_gap_is_not_longer_by_the_time_until_kubernetes_starts_a_killed_monitor_again() -> None:
    commands, commits = log(drive("a", 1, 20), drive("b", 50, 60)), [Commit(0.0, 1, ("a",)), Commit(50.0, 2, ("b",))]
    more = {"commits": commits, "recoveries": [recovery(49.0, 50.0)], "unmonitored": [(10.3, 44.0)]}
    froze = fault("freeze", 20.0, 22.0)
    assert whats(judged(commands, froze, **more)) == ["gap"]
    assert whats(judged(commands, fault("monitor-kill", 10.0), froze, **more)) == []


def test_a_failover_of_a_pod_that_is_being_deleted_is_right() -> None:
    commands, recoveries = log(drive("a", 1, 10.55), drive("b", 10.62, 20)), [recovery(10.5, 10.6)]
    assert whats(judged(commands, recoveries=recoveries, deleted={"a": 9.0})) == []
    assert whats(judged(commands, recoveries=recoveries, deleted={"a": 12.0})) == ["false failover"]
    noticed = [recovery(10.5, 10.6, reason="pod a is being deleted")]
    assert whats(judged(commands, recoveries=noticed, deleted={"a": 11.4})) == [], "the witness looks every second"
    assert whats(judged(commands, recoveries=noticed, deleted={"a": 12.5})) == ["false failover"]


def test_a_new_monitor_that_never_heard_the_instance_listened_for_the_seconds_that_it_reports() -> None:
    commands = log(drive("a", 1, 10.55), drive("b", 10.62, 20))
    recoveries = [recovery(10.5, 10.6, reason="no /scan within 6.1 s of the monitor's start")]
    lossy = fault("packet-loss", 3.0, 5.0)
    assert whats(judged(commands, lossy, recoveries=recoveries)) == []
    assert whats(judged(commands, lossy, recoveries=[recovery(10.5, 10.6)])) == ["false failover"]


def test_a_gap_is_not_longer_by_the_time_until_a_kubelet_starts_a_mux_again() -> None:
    commands = log(drive("a", 1, 10), drive("a", 35, 60))
    given: dict[str, Any] = {"muxed": True, "commits": [Commit(0.0, 1, ("a",))]}
    killed = fault("mux-kill", 10.02)
    assert whats(judged(commands, killed, **given)) == ["gap"]
    found = judged(commands, killed, unmuxed=[(10.0, 33.0)], **given)
    assert (whats(found), found.unmuxed) == ([], [23.0])
    assert whats(judged(commands, killed, unmuxed=[(10.0, 25.0)], **given)) == ["gap"]


def test_a_label_that_names_another_robot_s_workload_concerns_that_robot_too() -> None:
    other = replace(
        fault("label-exchange", 9.98, robot=5), told="understudy.dev/workload=robot-1-drive of robot-6-drive-x"
    )
    replaced = recovery(10.05, 10.6, reason="pod a is being deleted")
    commands = log(drive("a", 1, 10.1), drive("b", 10.65, 20))
    assert whats(judged(commands, other, recoveries=[replaced])) == []
    elsewhere = replace(other, told="understudy.dev/workload=robot-7-drive of robot-6-drive-x")
    assert whats(judged(commands, elsewhere, recoveries=[replaced])) == ["false failover"]


def test_a_gap_is_not_longer_by_the_time_until_a_kubelet_begins_to_start_a_pod() -> None:
    commands, commits = log(drive("a", 1, 10), drive("b", 90, 99)), [Commit(0.0, 1, ("a",)), Commit(90.0, 2, ("b",))]
    found = {"commits": commits, "recoveries": [recovery(11.0, 90.0, "Restart")]}
    assert whats(judged(commands, KILLED, **found)) == ["gap"]
    begun = judged(commands, KILLED, unstarted=[(12.0, 60.0)], **found)
    assert (whats(begun), begun.unstarted) == ([], [48.0])


@pytest.mark.parametrize(("closed", "expected"), [(True, []), (False, ["gap"])])
def test_a_recovery_that_is_given_up_may_have_waited_for_an_operator_that_creates_a_pod(
    closed: bool, expected: list[str]
) -> None:
    commands, commits = log(drive("a", 1, 10), drive("b", 50, 59)), [Commit(0.0, 1, ("a",)), Commit(49.9, 3, ("b",))]
    commits[1:1] = [Commit(10.1, 2, ())] if closed else []
    deleted = fault("delete", 10.0)
    assert whats(judged(commands, deleted, commits=commits, unled=[(9.0, 49.0)])) == expected


def test_a_fault_that_could_not_be_made_explains_nothing() -> None:
    commands = log(drive("a", 1, 10.55), drive("b", 10.62, 20))
    refused = Injected(KILLED.fault, 10.02, 10.02, refused="no pod")
    assert whats(judged(commands, refused, recoveries=[recovery(10.5, 10.6)])) == ["false failover"]
    unsure = replace(refused, refused="timed out", is_unsure=True)
    assert whats(judged(commands, unsure, recoveries=[recovery(10.5, 10.6)])) == [], "it may have been made"


def test_steps_that_go_back_by_more_than_the_age_of_kept_state_are_lost() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.62, 20))
    before = sum(command.source == "a" for command in commands)
    for back, expected in ((40, []), (before, ["state lost"])):
        steps = {c.sequence: c.sequence - (back if c.source == "b" else 0) for c in commands}
        found = judged(commands, KILLED, steps=steps)
        assert found.lost_steps == [back - 1]
        assert whats(found) == expected


@pytest.mark.parametrize(("takes", "expected"), [(0.3, []), (0.7, ["state lost"])])
def test_an_application_may_take_a_moment_to_act_on_the_state_that_it_was_given(
    takes: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.62, 20))
    steps = {c.sequence: 0 if c.source == "b" and c.sent < 10.62 + takes else c.sequence for c in commands}
    assert whats(judged(commands, KILLED, steps=steps)) == expected


@pytest.mark.parametrize(
    ("recoveries", "expected", "one_sided"),
    [
        ([], [], 5.0),
        ([recovery(11.0, 15.0)], ["gap"], None),
        ([recovery(14.5, 15.0, last_healthy=14.2)], [], 4.2),
        ([recovery(14.0, 15.0, last_healthy=11.0)], ["gap"], None),
    ],
    ids=["no recovery", "the monitor heard as little", "the monitor heard it for longer", "but not for long"],
)
def test_a_link_that_loses_packets_may_keep_them_from_the_robot_and_not_from_the_monitor(
    recoveries: list[Recovered], expected: list[str], one_sided: float | None
) -> None:
    lossy = fault("packet-delay", 9.9, 15.0)
    commits = [Commit(0.0, 1, ("a",))]
    found = judged(log(drive("a", 1, 10), drive("a", 15, 20)), lossy, commits=commits, recoveries=recoveries)
    assert whats(found) == expected
    assert found.one_sided == ([] if one_sided is None else [pytest.approx(one_sided, abs=0.05)])


@pytest.mark.parametrize(("victim", "back"), [("active", 70), ("standby", 16)])
def test_a_robot_that_stands_for_longer_than_packets_were_lost_or_by_another_instance_has_a_gap(
    victim: str, back: float
) -> None:
    lossy = fault("packet-loss", 9.9, 14.9)
    lossy = replace(lossy, fault=replace(lossy.fault, victim=victim))
    found = judged(log(drive("a", 1, 10), drive("a", back, 80)), lossy, commits=[Commit(0.0, 1, ("a",))])
    assert whats(found) == ["gap"]


@pytest.mark.parametrize(("led_again", "expected"), [(15.0, []), (12.0, ["gap"])])
def test_a_gate_that_somebody_deletes_stays_away_until_an_operator_leads(led_again: float, expected: list[str]) -> None:
    commands, commits = log(drive("a", 1, 10), drive("a", 16, 20)), [Commit(0.0, 1, ("a",))]
    found = judged(commands, fault("gate-delete", 10.0), commits=commits, unled=[(8.0, led_again)])
    assert whats(found) == expected
    assert whats(judged(commands, commits=commits, unled=[(8.0, led_again)])) == ["gap"], "nobody deleted it"


@pytest.mark.parametrize(("created", "expected"), [(13.0, []), (2.0, ["gap"])])
def test_an_instance_that_is_deleted_while_its_gate_is_missing_is_followed_by_a_new_one(
    created: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 17, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(13.4, 1, ()), Commit(17.0, 2, ("b",))]
    gate, gone = fault("gate-delete", 10.0), replace(fault("delete", 13.0, number=2), told="a ")
    more: Any = {"commits": commits, "unled": [(8.0, 13.0)], "created": {"b": created}}
    found = judged(commands, gate, gone, **more)
    assert whats(found) == expected
    assert all(violation.faults == (1, 2) for violation in found.violations)
    assert whats(judged(commands, gate, **more)) == ["gap"]


@pytest.mark.parametrize(("led_again", "expected"), [(13.0, []), (11.0, ["double drive", "fenced instance"])])
def test_an_instance_may_drive_beside_another_one_until_an_operator_restores_a_deleted_gate(
    led_again: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.62, 20), drive("a", 11.2, 13.4))
    found = judged(commands, KILLED, fault("gate-delete", 11.1), unled=[(9.0, led_again)])
    assert whats(found) == expected


@pytest.mark.parametrize(
    ("led_to", "strategy", "expected"),
    [
        (80.0, "Fallback/Uninitialized", []),
        (30.0, "Fallback/Uninitialized", ["gap"]),
        (80.0, "Fallback/Executing", ["gap"]),
    ],
    ids=["long", "short", "no new process had to be discovered"],
)
def test_the_time_in_which_kubernetes_led_nobody_to_the_discovery_server_is_not_counted(
    led_to: float, strategy: str, expected: list[str]
) -> None:
    commands, commits = log(drive("a", 1, 10), drive("b", 85, 90)), [Commit(0.0, 1, ("a",)), Commit(85.0, 2, ("b",))]
    recovered = recovery(10.5, 85.0, strategy)
    assert whats(judged(commands, KILLED, commits=commits, recoveries=[recovered], astray=[(9.0, led_to)])) == expected


@pytest.mark.parametrize(("server", "expected"), [("node1", []), ("node2", ["state lost"])])
def test_an_instance_that_restarts_in_place_loses_state_until_its_monitor_can_discover_it(
    server: str, expected: list[str]
) -> None:
    lost = replace(fault("node-power", 8.0, 14.0), told="node1")
    commands = log(drive("a", 1, 10), drive("a", 22, 30))
    steps = {c.sequence: 1000 + c.sequence if c.received <= 10 else c.sequence for c in commands}
    more: Any = {"steps": steps, "monitors": [(0.0, "node1"), (13.0, "node3")], "commits": [Commit(0.0, 1, ("a",))]}
    found = judged(commands, KILLED, lost, servers=[(0.0, server), (15.0, "node3")], **more)
    assert [what for what in whats(found) if what == "state lost"] == expected


@pytest.mark.parametrize(("lost", "expected"), [("node1", []), ("node2", ["state lost"])])
def test_an_instance_that_restarts_in_place_while_no_monitor_watches_loses_state_until_one_does(
    lost: str, expected: list[str]
) -> None:
    cut = replace(fault("node-cut", 8.0, 14.0), told=lost)
    commands = log(drive("a", 1, 10), drive("a", 12, 20))
    steps = {c.sequence: 1000 + c.sequence if c.received <= 10 else c.sequence for c in commands}
    more: Any = {"steps": steps, "monitors": [(0.0, "node1"), (25.0, "node3")], "commits": [Commit(0.0, 1, ("a",))]}
    found = judged(commands, KILLED, cut, **more)
    assert [what for what in whats(found) if what == "state lost"] == expected


@pytest.mark.parametrize(
    ("next_monitor", "kept_until", "expected"),
    [(60.0, 30.0, []), (60.0, 20.0, ["state lost"]), (40.0, 30.0, ["state lost"])],
)
def test_what_an_instance_did_while_no_monitor_ran_is_kept_by_nobody(
    next_monitor: float, kept_until: float, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 62), drive("b", 63, 70))
    lost = round((62 - kept_until) / PERIOD)
    steps = {c.sequence: c.sequence - (lost if c.source == "b" else 0) for c in commands}
    more: Any = {"commits": [Commit(0.0, 1, ("a",)), Commit(62.9, 2, ("b",))], "recoveries": [recovery(62.5, 63.0)]}
    found = judged(commands, fault("kill", 62.02), steps=steps, unmonitored=[(30.0, next_monitor)], **more)
    assert [what for what in whats(found) if what == "state lost"] == expected
    assert found.unkept == ([pytest.approx(640, abs=1)] if next_monitor == 60.0 else [])


@pytest.mark.parametrize(("monitor", "expected"), [("node1", []), ("node2", ["state lost"])])
def test_no_state_is_kept_by_a_monitor_that_is_cut_off_with_its_node(monitor: str, expected: list[str]) -> None:
    """It ends 6 s after its node is back, and its successor is ready just before the instance fails."""
    cut = replace(fault("node-cut", 40.0, 46.0), told="node1")
    commands = log(drive("a", 1, 62), drive("b", 63, 70))
    steps = {c.sequence: c.sequence if c.source == "a" else 20 * 39 + c.sequence - 20 * 62 for c in commands}
    more: Any = {"steps": steps, "nodes": {"a": "node3"}, "commits": [Commit(0.0, 1, ("a",)), Commit(63.0, 2, ("b",))]}
    more |= {"monitors": [(0.0, monitor), (60.0, "node3")], "unmonitored": [(52.0, 60.0)]}
    found = judged(commands, cut, fault("kill", 62.02), **more)
    assert [what for what in whats(found) if what == "state lost"] == expected


@pytest.mark.parametrize(("monitor", "expected"), [("node1", []), ("node2", ["state lost"])])
def test_the_state_of_an_instance_is_lost_with_the_node_of_its_monitor(monitor: str, expected: list[str]) -> None:
    commands = log(drive("a", 1, 62), drive("b", 70, 78))
    steps = {c.sequence: c.sequence if c.source == "a" else c.sequence - 1240 for c in commands}
    more: Any = {"commits": [Commit(0.0, 1, ("a",)), Commit(69.9, 2, ("b",))], "recoveries": [recovery(69.5, 69.9)]}
    off = replace(fault("node-power", 62.0, 72.0), told="node1")
    nodes, monitors = {"a": "node1", "b": "node3"}, [(0.0, monitor), (68.0, "node3")]
    found = judged(commands, off, steps=steps, nodes=nodes, monitors=monitors, **more)
    assert [what for what in whats(found) if what == "state lost"] == expected


def test_what_an_instance_did_while_its_monitor_was_frozen_is_kept_by_nobody() -> None:
    commands = log(drive("a", 1, 62), drive("b", 63, 70))
    steps = {c.sequence: c.sequence - (200 if c.source == "b" else 0) for c in commands}
    more: Any = {"commits": [Commit(0.0, 1, ("a",)), Commit(62.9, 2, ("b",))], "recoveries": [recovery(62.5, 63.0)]}
    killed, frozen = fault("kill", 62.02), fault("monitor-freeze", 50.0, 64.0, number=2)
    assert whats(judged(commands, killed, steps=steps, **more)) == ["state lost"]
    assert whats(judged(commands, killed, frozen, steps=steps, **more)) == []


@pytest.mark.parametrize(("begun", "expected"), [(6.6, []), (-30.0, ["state lost"])])
def test_an_instance_may_restart_in_place_while_nobody_can_fence_it(begun: float, expected: list[str]) -> None:
    commands = log(drive("a", 1, 10), drive("a", 11.9, 12.6), drive("b", 13.0, 20))
    steps = {c.sequence: c.sequence - (180 if 11 < c.received < 12.7 else 0) for c in commands}
    more: Any = {"commits": [Commit(0.0, 1, ("a",)), Commit(12.62, 2, ("b",))], "recoveries": [recovery(11.0, 12.9)]}
    stopped = fault("api-stop", begun, begun + 5.9, robot=-1, number=2)
    found = judged(commands, KILLED, stopped, steps=steps, **more)
    assert [what for what in whats(found) if what == "state lost"] == expected


def test_what_an_instance_did_after_it_was_fenced_is_no_lost_state() -> None:
    returned = [Command(15.0, "a", 0, 15.0, *[0.0] * 6)]
    commands = log(drive("a", 1, 10), drive("b", 10.62, 14.9), returned, drive("b", 15.01, 20))
    steps = {c.sequence: round(c.sent / PERIOD) + (900 if c.received == 15.0 else 0) for c in commands}
    assert judged(commands, KILLED, steps=steps).lost_steps == []


def test_a_command_that_arrives_late_loses_no_steps() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.61, 10.61, age=2.0), drive("b", 10.66, 20))
    steps = {c.sequence: round(c.sent / PERIOD) for c in commands}
    assert judged(commands, KILLED, steps=steps).lost_steps == []


def test_goals_are_lost_without_a_success_and_doubled_when_they_are_finished_twice() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.62, 20))
    goals = {"one": "succeeded", "two": "aborted", "three": ""}
    finished = [("one", "a"), ("one", "b"), ("four", "a"), ("four", "a")]
    found = judged(commands, KILLED, goals=goals, finished=finished)
    assert whats(found) == ["goal lost", "goal lost", "goal doubled", "goal doubled"]


def test_windows_that_overlap_cover_time_once() -> None:
    assert covered([(0, 4), (3, 6), (9, 20), (30, 40)], 2, 10) == 5
    assert covered([], 2, 10) == 0


def test_every_shared_kind_affects_every_robot() -> None:
    for kind in BY_NAME.values():
        commands, recoveries = log(drive("a", 1, 10.55), drive("b", 10.62, 20)), [recovery(10.5, 10.6)]
        found = judged(commands, fault(kind.name, 9.5, 10.4, robot=5), recoveries=recoveries)
        assert (whats(found) == []) == bool(kind.shared and kind.disturbs)


def test_commands_of_two_instances_that_take_turns_behind_a_mux_are_explained_by_nothing() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.6, 50), drive("a", 30.01, 32.0))
    faults = [replace(fault("node-cut", 10.02, 30.0), told="n3")]
    more: Any = {"recoveries": [recovery(10.5, 10.6)], "nodes": {"a": "n3", "b": "n2"}}
    assert "double drive" in whats(judged(commands, *faults, muxed=True, **more))
    assert whats(judged(commands, *faults, **more)) == []


@pytest.mark.parametrize(("kind", "expected"), [("monitor-freeze", []), ("packet-loss", ["fenced instance"])])
def test_a_fenced_instance_drives_alone_behind_a_mux_until_the_order_arrives(kind: str, expected: list[str]) -> None:
    commands = log(drive("a", 1, 14), drive("b", 14.06, 20))
    found = judged(commands, fault(kind, 10.5, 13.0), muxed=True)
    assert whats(found) == expected
    assert bool(found.unordered) is not bool(expected)


def test_a_switch_of_the_mux_s_own_is_explained_by_the_commit_after_it() -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.3, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(15.0, 2, ("b",))]
    assert whats(judged(commands, fault("api-stop", 9.9, 14.5), commits=commits, muxed=True)) == []


@pytest.mark.parametrize(("ended", "expected"), [(5.0, []), (-100.0, ["gap"])])
def test_a_pod_that_kubernetes_replaces_late_after_an_outage_is_nobodys_gap(ended: float, expected: list[str]) -> None:
    commands = log(drive("a", 1, 10), drive("b", 85, 100))
    faults = [fault("api-stop", ended - 4.0, ended), replace(fault("delete", 10.0, number=2), told="a ")]
    more: Any = {"deleted": {"a": 10.0}, "created": {"b": 80.0}, "commits": [
        Commit(0.0, 1, ("a",)), Commit(10.2, 2, ()), Commit(84.9, 3, ("b",)),
    ]}  # fmt: skip
    assert whats(judged(commands, *faults, **more)) == expected


@pytest.mark.parametrize(("kind", "expected"), [("gate-delete", []), ("label-remove", ["gap"])])
def test_a_gate_that_is_deleted_when_it_has_just_opened_opens_again_after_the_silence_of_the_former_instance(
    kind: str, expected: list[str]
) -> None:
    commands = log(drive("a", 1, 10), drive("b", 10.6, 10.7), drive("b", 17, 20))
    commits = [Commit(0.0, 1, ("a",)), Commit(10.6, 2, ("b",)), Commit(10.8, 3, ()), Commit(17.0, 4, ("b",))]
    assert whats(judged(commands, KILLED, fault(kind, 9.5, 10.7, number=2), commits=commits)) == expected
