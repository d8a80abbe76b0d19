"""A live tree as lines of text."""

from __future__ import annotations

from tests.support.fake_monitor import leaf, state
from tests.support.golden import assert_golden
from understudy.cli.common.text.tree_text import Rates, lines


def printed(*looks: dict[str, object], colours: bool = False) -> list[str]:
    rates = Rates()
    for look in looks:
        rates.update(look)
    return list(lines(looks[-1], rates, colours=colours))


def test_a_healthy_tree_is_shown() -> None:
    later = state(102.0)
    later["tree"]["children"][0]["received"] = 30
    head, control, empty, *nodes = printed(state(), later)
    assert head == "fleet/robot-1-drive  Healthy"
    assert_golden(
        "command_line", control, "robot-1-drive-abc", "epoch 3", "policy navigation", "Executing", "recoveries: 2"
    )
    assert empty == ""
    assert [line.split("  ", 1)[0] if line[0] != " " else line[:45].rstrip() for line in nodes] == [
        "parallel",
        "  scan",
        "  driving (while /navigate_to_pose is active)",
        "    cmd_vel",
        "  node (publisher)",
    ]
    assert [line[45:].split() for line in nodes] == [
        ["healthy"], ["healthy", "10", "Hz,", "50", "ms", "ago"], ["idle"], ["idle"], ["healthy"],
    ]  # fmt: skip


def test_no_rate_is_shown_before_two_samples_or_after_a_monitor_restart() -> None:
    assert "Hz" not in "".join(printed(state()))
    latest = state(104.0)
    latest["tree"]["children"][0]["received"] = 1
    assert "Hz" not in "".join(printed(state(), state(102.0), latest))


def test_a_failure_is_shown_with_its_reason_and_colour() -> None:
    tree = leaf("scan", "Failed", reason="/scan is silent", age=1.2)
    found = printed(state(health="Failed", tree=tree), colours=True)
    assert found[0] == "fleet/robot-1-drive  \x1b[1;31mFailed\x1b[0m"
    assert found[3].endswith("1.2 s ago               /scan is silent")
    assert "\x1b[1;31mFAILED" in found[3]


def test_control_characters_are_escaped() -> None:
    tree = leaf("scan\x1b[2J", "Failed", reason="a\nb\r")
    found = "\n".join(printed(state(tree=tree, notes=["\x1b]0;gone\x07"], active="\x9b1A")))
    assert not set("\x1b\r\x07\x9b") & set(found)
    assert "scan\\x1b[2J" in found
    assert "a\\nb\\r" in found


def test_a_workload_without_tree_and_active_instance_is_shown() -> None:
    found = printed(state(tree=None, active="", strategy="", policy="", health="Unknown", notes=["/scan: no type"]))
    assert_golden("command_line", found[1], "none (epoch 3)", "policy none", "unknown", "recoveries: 2")
    assert found[3:] == ["There is no health tree to evaluate.", "", "/scan: no type"]


def test_the_degraded_condition_is_shown_only_while_it_is_true() -> None:
    condition = {"type": "Degraded", "status": "True", "reason": "NotWell", "message": "/scan at 8.6 Hz, below 9 Hz\n."}
    found = printed(state(health="Degraded", conditions=[condition]), colours=True)
    assert found[0] == "fleet/robot-1-drive  \x1b[33mDegraded\x1b[0m"
    assert found[2] == "degraded: /scan at 8.6 Hz, below 9 Hz\\n."
    well = printed(state(conditions=[condition | {"status": "False"}]))
    assert not any(line.startswith("degraded") for line in well)
