"""What a mux reports shows whom the gate lets through, as long as the reports are fresh."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace

import pytest

from understudy.api.protocol.mux_messages import Order, Report, Token
from understudy.clock import CLOCK
from understudy.kube.gates import mux_reports
from understudy.kube.gates.base import OwnSwitch
from understudy.kube.gates.mux_reports import MuxReports

ORDER = Order(1000.0, 5, "w-1")
REPORT = Report(ORDER.token, "w-1", "n", forwarded=3, since=0.2, heard={"w-1": {"/cmd_vel": 0.05}})


def ordered(reports: MuxReports, order: Order = ORDER, nonce: str = "n") -> None:
    reports.ordered(f"uid of {order.source}" if order.source else "", order, nonce)


@pytest.fixture
def reports() -> MuxReports:
    found = MuxReports()
    ordered(found)
    return found


def test_the_instance_that_is_ordered_and_forwarded_has_evidence(reports: MuxReports) -> None:
    assert reports.last("uid of w-1") is None
    reports.add(REPORT)
    last = reports.last("uid of w-1")
    assert last is not None
    assert reports.heard_since(last) == ["uid of w-1"]
    assert reports.reported("w-1")[:2] == ("True", "ReportedByMux")


def test_a_report_that_answers_no_recent_order_does_not_count(reports: MuxReports) -> None:
    reports.add(replace(REPORT, nonce="recorded"))
    assert reports.latest is None
    for number in range(mux_reports.NONCES):
        ordered(reports, nonce=f"later {number}")
    reports.add(REPORT)
    assert reports.latest is None


@pytest.mark.parametrize(
    ("token", "named", "expected"),
    [
        (Token(1000.0, 9), "w-2", 9),
        (Token(1000.0, 5), "w-2", 5),
        (Token(1000.0, 5, 1), "", 5),
        (Token(1000.0, 5, 1), "w-1", 0),
        (Token(1000.0, 4), "w-2", 0),
        (Token(2000.0, 9), "w-2", 0),
    ],
    ids=[
        "newer",
        "used before",
        "used before, and switched since",
        "a switch of its own, and the disk is full",
        "older, so the disk is full",
        "of another workload",
    ],
)
def test_an_epoch_that_the_mux_refuses_for_another_one_is_known(
    reports: MuxReports, token: Token, named: str, expected: int
) -> None:
    reports.add(replace(REPORT, token=token, source="w-2", ordered=named))
    assert reports.carried_out(5) == 0, "it refuses nothing"
    reports.add(replace(REPORT, token=token, source="w-2", ordered=named, refused="the order is refused"))
    assert reports.carried_out(5) == expected
    assert reports.carried_out(6) == 0, "no order of the present gate is answered yet"


async def test_who_waits_is_woken_by_the_report_that_carries_the_order_out(reports: MuxReports) -> None:
    reports.add(REPORT)
    began = CLOCK.now()
    ordered(reports, replace(ORDER, epoch=6, source="w-2"), "later")
    waiting = asyncio.create_task(reports.wait("uid of w-2", began))
    await asyncio.sleep(0)
    reports.add(REPORT)
    reports.add(replace(REPORT, nonce="later"))
    await asyncio.sleep(0)
    assert not waiting.done(), "the mux still forwards the former one"
    reports.add(replace(REPORT, nonce="later", token=Token(1000.0, 6), source="w-2"))
    assert await waiting >= began


def test_a_switch_of_the_muxs_own_is_no_evidence_for_whom_the_gate_names(reports: MuxReports) -> None:
    reports.add(replace(REPORT, token=Token(1000.0, 5, 1), source="w-2"))
    assert reports.last("uid of w-1") is None
    assert reports.reported("w-1")[0] == "Unknown"


def test_a_switch_of_the_muxs_own_is_a_takeover_with_the_times_of_both(reports: MuxReports) -> None:
    assert reports.switched("w-1") is None
    reports.add(REPORT)
    assert reports.switched("w-1") is None
    heard = {"w-1": {"/cmd_vel": 0.4, "/lamp": 0.3}, "w-2": {"/cmd_vel": 0.0}}
    switch = replace(REPORT, token=Token(1000.0, 5, 1), source="w-2", since=0.1, heard=heard)
    reports.add(replace(switch, forwarded=0, since=math.inf))
    assert reports.switched("w-1") is None, "the robot has received nothing of it"
    reports.add(switch)
    assert reports.latest is not None
    now = CLOCK.to_system(reports.latest.at)
    assert reports.switched("w-1") == ("w-2", pytest.approx(now - 0.3), pytest.approx(now - 0.1))
    ordered(reports, replace(ORDER, epoch=6, source="w-2"), "later")
    assert reports.switched("w-2") is None, "it is committed"
    assert reports.switched("w-1") is None, "the mux has not answered the last order yet"


def test_a_switch_that_nobody_commits_is_reported_with_both_instances(reports: MuxReports) -> None:
    switch = replace(REPORT, token=Token(1000.0, 5, 1), source="w-2", since=0.1)
    reports.add(switch)
    assert reports.reported("w-1")[:2] == ("Unknown", "Settling"), "the monitor is about to commit it"
    reports.add(replace(switch, since=mux_reports.SILENT + 0.1))
    status, reason, message = reports.reported("w-1")
    assert (status, reason) == ("Unknown", mux_reports.SWITCHED_BY_MUX)
    assert "switched to w-2" in message
    assert "names w-1" in message
    ordered(reports, replace(ORDER, epoch=6, source="w-3"), "later")
    assert reports.reported("w-3")[:2] == ("Unknown", "Settling"), "the order is on its way"


def test_a_commit_knows_only_the_switches_from_before_it_was_decided(reports: MuxReports) -> None:
    """The API server is away for long, and the mux switches once more before it carries the commit of the first switch out."""
    first = replace(REPORT, token=Token(1000.0, 5, 1), source="w-2")
    reports.add(first)
    reports.deciding()
    reports.add(replace(first, token=Token(1000.0, 5, 2), source="w-3"))
    reports.committed(6)
    assert reports.known(6) == Token(1000.0, 5, 1)
    assert reports.known(7) == Token(), "another monitor made that commit"
    ordered(reports, replace(ORDER, epoch=6, source="w-2"), "later")
    refusal = "the mux has switched to w-3 by itself"
    reports.add(replace(first, nonce="later", token=Token(1000.0, 5, 2), source="w-3", refused=refusal))
    found = reports.switched("w-2")
    assert found is not None
    assert found[0] == "w-3", "this is decided next"


def test_a_silent_mux_a_refusal_and_a_stranger_are_reported(reports: MuxReports) -> None:
    assert reports.reported("w-1")[:2] == ("Unknown", "Settling")
    assert not reports.is_away, "it may not have found this monitor yet"
    reports.add(replace(REPORT, refused="the order is of epoch 4"))
    status, reason, message = reports.reported("w-1")
    assert (status, reason) == ("False", "OrderRefused")
    assert "epoch 4" in message
    reports.add(replace(REPORT, strangers=("/cmd_vel by /teleop",)))
    status, reason, message = reports.reported("w-1")
    assert (status, reason) == ("False", "BesideTheMux")
    assert "/cmd_vel by /teleop" in message
    assert reports.latest is not None
    reports.latest = replace(reports.latest, at=CLOCK.now() - 1.1 * mux_reports.SILENT)
    assert reports.is_away, "it had found this monitor"
    assert reports.reported("w-1")[:2] == ("False", "NoMux")
    assert reports.strangers == ()


def test_a_closed_gate_is_reported_too() -> None:
    reports = MuxReports()
    ordered(reports, replace(ORDER, source=""))
    reports.add(replace(REPORT, source="", forwarded=0, since=math.inf))
    assert reports.reported("")[1:] == ("ReportedByMux", "The mux at the robot reports that it forwards nobody.")
    assert reports.heard() == {}
    assert reports.forwarded("") is None


def test_what_is_forwarded_has_times_of_this_process(reports: MuxReports) -> None:
    reports.add(REPORT)
    found = reports.forwarded("w-1")
    assert found is not None
    assert found.forwarding_since == pytest.approx(found.at - 0.2)
    assert reports.heard() == {"/cmd_vel": pytest.approx(found.at - 0.05)}
    assert reports.forwarded("w-2") is None


def test_an_instance_to_which_the_mux_switched_and_that_does_not_send_is_idle_after_a_while(
    reports: MuxReports, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = CLOCK.now()
    monkeypatch.setattr(CLOCK, "now", lambda: now)
    silent = replace(REPORT, token=Token(1000.0, 5, 1), source="w-2", forwarded=0, since=math.inf)
    reports.add(silent)
    assert reports.own_switch("w-1") == OwnSwitch("w-2", is_idle=False, active_sends=True)
    assert reports.switched("w-1") is None
    now += mux_reports.SILENT
    reports.add(replace(silent, heard={"w-1": {"/cmd_vel": 0.05, "/fork": 2.0}}))
    assert reports.own_switch("w-1") == OwnSwitch("w-2", is_idle=True, active_sends=False)
    reports.add(replace(silent, forwarded=1, since=0.0, heard={}))
    assert reports.own_switch("w-1") == OwnSwitch("w-2", is_idle=False, active_sends=False)
    reports.add(replace(silent, heard=silent.heard | {"w-2": {"/cmd_vel": mux_reports.SILENT}}))
    assert reports.own_switch("w-1") == OwnSwitch("w-2", is_idle=True, active_sends=True), (
        "it was while nobody reported"
    )
    assert reports.own_switch("w-2") is None


def test_a_switch_from_the_ordered_instance_counts_if_the_report_answers_that_order(reports: MuxReports) -> None:
    other = replace(REPORT, token=Token(1000.0, 5, 1), source="w-2")
    reports.add(REPORT)
    assert reports.switched_from("w-1", "uid of w-1") == ""
    reports.add(other)
    assert reports.switched_from("w-1", "uid of w-1") == "w-2"
    assert reports.switched_from("w-2", "uid of w-2") == ""
    ordered(reports, Order(1000.0, 6, "w-3"), nonce="n-2")
    assert reports.switched_from("w-3", "uid of w-3") == "", "the mux may not have received the order yet"
    reports.add(replace(other, nonce="n-2", refused="it has switched to w-2 by itself"))
    assert reports.switched_from("w-3", "uid of w-3") == "w-2"


@pytest.mark.parametrize(
    ("token", "source", "forwarded", "is_back"),
    [
        (Token(1000.0, 5, 2), "w-1", 3, True),
        (Token(1000.0, 5, 1), "w-2", 3, False),
        (Token(1000.0, 5, 2), "w-1", 0, False),
        (Token(1000.0, 5), "w-1", 3, False),
        (Token(1000.0, 4, 2), "w-1", 3, False),
    ],
    ids=["returned", "switched", "nothing forwarded yet", "never switched", "of an older epoch"],
)
def test_the_mux_is_back_at_the_active_instance_once_it_forwards_that_again(
    reports: MuxReports, token: Token, source: str, forwarded: int, is_back: bool
) -> None:
    reports.add(replace(REPORT, token=token, source=source, forwarded=forwarded))
    assert reports.is_back(ORDER.source) == is_back


def test_the_instance_on_board_is_no_switch_that_anybody_commits(reports: MuxReports) -> None:
    reports.add(replace(REPORT, token=Token(1000.0, 5, 1), source="home", on_board=True))
    assert reports.own_switch("w-1") is None
    assert reports.switched("w-1") is None
    assert reports.driven_on_board(5) is not None
    assert reports.driven_on_board(6) is None
    assert reports.reported("w-1")[:2] == ("False", "OnBoard")


def test_one_of_two_muxes_counts_until_it_is_silent(reports: MuxReports, monkeypatch: pytest.MonkeyPatch) -> None:
    now = CLOCK.now()
    monkeypatch.setattr(CLOCK, "now", lambda: now)
    reports.add(replace(REPORT, mux="m-1"))
    assert (reports.mux, reports.wanted.is_set()) == ("m-1", True), "an order that names it is due at once"
    reports.add(replace(REPORT, mux="m-2", source=""))
    assert reports.mux == "m-1"
    status, reason, message = reports.reported("w-1")
    assert (status, reason) == ("False", "TwoMuxes")
    assert "m-2 forwards nobody" in message
    now += mux_reports.SILENT + 0.1
    reports.add(replace(REPORT, mux="m-2"))
    assert reports.mux == "m-2"
    assert reports.reported("w-1")[:2] == ("True", "ReportedByMux")
