"""Which of several action proxies of a workload ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from understudy.action_proxy.succession import GONE_AFTER, OLD, REPLACED_AFTER, Announcement, Succession
from understudy.api.protocol.agent_messages import GateEpoch


def gate(number: int, workload: str = "uid-w") -> GateEpoch:
    return GateEpoch(workload, number)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Announcement(gate(5), 100.0, "a"), Announcement(gate(4), 1.0, "b")),
        (Announcement(gate(5), 1.0, "a"), Announcement(gate(5), 100.0, "b")),
        (Announcement(gate(5), 1.2, "b"), Announcement(gate(5), 1.0, "a")),
        (Announcement(gate(1, "uid-new"), 1.0, "a"), Announcement(gate(5), 100.0, "b")),
    ],
    ids=["it knows a later switch", "its pod is newer", "both pods started together", "the other workload was deleted"],
)
def test_exactly_one_of_two_proxies_replaces_the_other(one: Announcement, other: Announcement) -> None:
    assert one.replaces(other)
    assert not other.replaces(one)
    assert Announcement.from_wire(one.to_wire()) == one


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '["uid", 1, "2", "pod"]',
        '{"epoch": 1}',
        "[1, 2.0]",
        '["uid", 1, NaN, "pod"]',
        '["uid", 1, 1e400, "pod"]',
        pytest.param(f'["uid", {"9" * 5000}, 2.0, "pod"]', id="5000 digits"),
        pytest.param("[" * 100_000, id="100000 brackets"),
        pytest.param(f'["uid", 1, 2.0, "{"x" * 5000}"]', id="5000 characters"),
    ],
)
def test_an_invalid_announcement_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"announcement|Expecting"):
        Announcement.from_wire(text)


def test_proxies_that_do_not_replace_this_one_are_not_remembered(tmp_path: Path) -> None:
    """Any participant of the DDS domain may announce as many as it likes."""
    proxy = Succession(tmp_path, 0.0, "boot")
    for number in range(100):
        proxy.hear(Announcement(gate(4), 100.0, f"pod-{number}"), gate(5), 1.0)
    assert not proxy._greater


def test_a_proxy_is_replaced_after_several_announcements_in_a_row(tmp_path: Path) -> None:
    proxy = Succession(tmp_path, 0.0, "boot")
    newer, before_the_switch = Announcement(gate(3), 10.0, "b"), Announcement(gate(2), 10.0, "b")
    for _ in range(REPLACED_AFTER - 1):
        proxy.hear(newer, gate(3), 100.0)
    assert not proxy.is_replaced
    proxy.hear(before_the_switch, gate(3), 100.0)
    proxy.hear(newer, gate(3), 100.0)
    assert not proxy.is_replaced, "not in a row"
    for _ in range(REPLACED_AFTER - 1):
        proxy.hear(newer, gate(3), 100.0)
    assert proxy.is_replaced


def test_a_proxy_without_a_report_of_its_monitor_ends_only_for_a_newer_pod(tmp_path: Path) -> None:
    proxy = Succession(tmp_path, 0.0, "boot")
    for _ in range(REPLACED_AFTER):
        proxy.hear(Announcement(gate(9), 500.0, "older"), None, 100.0)
    assert not proxy.is_replaced
    for _ in range(REPLACED_AFTER):
        proxy.hear(Announcement(gate(9), 50.0, "newer"), None, 100.0)
    assert proxy.is_replaced


def test_a_proxy_does_not_count_its_own_announcements(tmp_path: Path) -> None:
    proxy = Succession(tmp_path, 0.0, "boot")
    for _ in range(REPLACED_AFTER):
        proxy.hear(proxy.own(gate(7), 2.0), gate(3), 2.0)
    assert not proxy.is_replaced


def test_the_next_process_of_the_pod_is_as_old_and_waits_until_the_other_proxy_is_gone(tmp_path: Path) -> None:
    first = Succession(tmp_path, 0.0, "boot")
    assert first.may_serve(0.0)
    first.end()
    again = Succession(tmp_path, 100.0, "boot")
    assert again.own(gate(1), 100.0) == Announcement(gate(1), 100.0, first.own(gate(1), 0.0).pod)
    for _ in range(REPLACED_AFTER):
        again.hear(Announcement(gate(1), 5.0, "b"), None, 104.0)
    assert not again.may_serve(104.0 + GONE_AFTER - 0.1)
    assert again.may_serve(104.0 + GONE_AFTER)
    again.serve()
    assert not again.is_replaced
    assert Succession(tmp_path, 200.0, "boot").may_serve(200.0), "a process that is killed then does not wait"


def test_a_proxy_serves_although_its_folder_cannot_be_written(tmp_path: Path) -> None:
    proxy = Succession(tmp_path / "full", 0.0, "boot")
    proxy.end()
    proxy.serve()
    assert proxy.may_serve(0.0)


def test_a_pod_whose_node_has_booted_since_is_old(tmp_path: Path) -> None:
    first = Succession(tmp_path, 50_000.0, "boot")
    again = Succession(tmp_path, 20.0, "another boot")
    assert again.own(gate(1), 20.0) == Announcement(gate(1), OLD, first.own(gate(1), 0.0).pod)
    assert Succession(tmp_path, 30.0, "another boot").own(gate(1), 30.0).age == OLD + 10.0


def test_a_proxy_that_waits_serves_once_its_monitor_knows_a_later_switch(tmp_path: Path) -> None:
    Succession(tmp_path, 0.0, "boot").end()
    proxy, newer = Succession(tmp_path, 100.0, "boot"), Announcement(gate(4), 5.0, "b")
    for now in range(100, 120):
        proxy.hear(newer, gate(4), float(now))
    assert not proxy.may_serve(119.0)
    for now in range(120, 126):
        proxy.hear(newer, gate(5), float(now))
    assert proxy.may_serve(125.0)
