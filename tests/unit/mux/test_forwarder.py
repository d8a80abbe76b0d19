"""A mux forwards what the control says at the moment at which a sample arrives, keeps each decision first, and reports."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from understudy.api.protocol.mux_messages import (
    OnBoard,
    Order,
    Report,
    SafeCommand,
    StandingOrder,
    Token,
    derive,
    order_text,
    read_report,
)
from understudy.mux.control import Control
from understudy.mux.control_journal import ControlJournal
from understudy.mux.forwarder import Forwarder

KEYS = derive(b"token", "fleet", "w")
ORDER = Order(1000.0, 5, "w-1", standing=StandingOrder(("w-2",), {"/cmd_vel": 0.5}))
GIDS = {"w-1": b"1" * 16, "w-2": b"2" * 16, "robot": b"9" * 16}


class GivenTopic:
    """Samples that arrive, and those that were forwarded."""

    output = "/cmd_vel"

    def __init__(self) -> None:
        self.arrived: list[bytes] = []
        self.forgotten = 0
        self.forwarded: list[str] = []

    def send(self, *writers: str) -> None:
        self.arrived += [GIDS[writer] for writer in writers]

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        accepted = [gid for gid in self.arrived if forwards(gid)]
        self.arrived.clear()
        names = {gid: name for name, gid in GIDS.items()}
        self.forwarded += [names[gid] for gid in accepted]
        return len(accepted)

    def forget(self) -> None:
        self.forgotten += 1

    def command(self, values: Mapping[str, Any]) -> None:
        if values.get("field") == "wrong":
            raise ValueError("no such field")
        self.forwarded.append("safe")


class Stand:
    """One workload's mux, at a time that a test says."""

    def __init__(self, folder: Path, identity: str = "") -> None:
        self.topic, self.now, self._folder, self._identity = GivenTopic(), 100.0, folder, identity
        self.start()

    def start(self) -> None:
        journal = ControlJournal(self._folder / "control.json")
        self.mux = Forwarder([self.topic], KEYS, journal, self._identity, clock=lambda: self.now)
        self.mux.instances = {GIDS["w-1"]: "w-1", GIDS["w-2"]: "w-2", GIDS["robot"]: ""}

    def order(self, order: Order, nonce: str = "n") -> Report:
        self.mux.order(order_text(order, nonce, KEYS))
        return self.report

    @property
    def report(self) -> Report:
        return read_report(self.mux.report(), KEYS)

    def after(self, seconds: float, *writers: str) -> None:
        """Let time pass, and then samples arrive."""
        self.now += seconds
        self.topic.send(*writers)
        self.mux.drain()


@pytest.fixture
def stand(tmp_path: Path) -> Stand:
    return Stand(tmp_path)


def test_an_instance_that_is_heard_for_the_first_time_is_reported_at_once(stand: Stand) -> None:
    assert stand.order(ORDER).heard == {}
    stand.after(0.1, "w-1")
    assert stand.mux.changed
    assert stand.report.heard.keys() == {"w-1"}
    stand.after(0.1, "w-1")
    assert not stand.mux.changed
    stand.after(0.1, "w-2")
    assert stand.mux.changed, "a switchover may wait for it"
    assert stand.report.heard.keys() == {"w-1", "w-2"}


def test_only_the_instance_that_was_ordered_is_forwarded(stand: Stand) -> None:
    stand.after(0.1, "w-1", "w-2", "robot")
    assert stand.topic.forwarded == []
    stand.order(ORDER)
    stand.after(0.1, "w-2", "w-1", "robot")
    assert stand.topic.forwarded == ["w-1"]


def test_what_arrived_before_an_order_is_not_forwarded(stand: Stand) -> None:
    stand.order(ORDER)
    stand.topic.send("w-2", "w-1")
    stand.order(replace(ORDER, epoch=6, source="w-2"))
    assert stand.topic.forwarded == ["w-1"]
    stand.after(0.0, "w-1", "w-2")
    assert stand.topic.forwarded == ["w-1", "w-2"]


def test_what_is_held_of_unknown_writers_is_dropped_when_another_instance_is_put_in_control(stand: Stand) -> None:
    stand.order(ORDER)
    assert stand.topic.forgotten == 1
    stand.order(ORDER, "again")
    stand.order(replace(ORDER, epoch=6))
    assert stand.topic.forgotten == 1
    stand.order(replace(ORDER, epoch=7, source="w-2"))
    assert stand.topic.forgotten == 2


def test_a_writer_that_discovery_has_not_reported_is_not_forwarded(stand: Stand) -> None:
    stand.order(ORDER)
    del stand.mux.instances[GIDS["w-1"]]
    stand.after(0.1, "w-1")
    assert stand.topic.forwarded == []


def test_a_silent_instance_is_replaced_without_an_order(stand: Stand) -> None:
    stand.order(ORDER)
    stand.after(0.1, "w-1", "w-2")
    assert stand.mux.due_at == pytest.approx(stand.now + 0.5)
    stand.after(0.45, "w-2")
    assert stand.report.source == "w-1"
    stand.after(0.06, "w-2")
    report = stand.report
    assert (report.source, report.token) == ("w-2", Token(1000.0, 5, 1))
    stand.after(0.01, "w-1", "w-2")
    assert stand.topic.forwarded == ["w-1", "w-2"], "the first one does not come back by itself"


def test_a_silence_that_nobody_can_end_is_looked_at_once(stand: Stand) -> None:
    stand.order(ORDER)
    stand.after(0.1, "w-1")
    assert stand.mux.due_at == pytest.approx(stand.now + 0.5)
    stand.after(0.5)
    assert stand.mux.due_at == math.inf, "w-2 is silent too, so only its next sample changes anything"
    stand.after(0.1, "w-2")
    assert stand.report.source == "w-2"


SAFE = replace(ORDER, standing=StandingOrder(safe=(SafeCommand("/cmd_vel", {}, 0.1),), safe_after=0.2))


def test_safe_commands_are_sent_at_their_period_while_nobody_is_in_control_and_end_with_an_instance(
    stand: Stand,
) -> None:
    stand.order(replace(SAFE, source=""))
    stand.after(0.1, "w-1")
    assert stand.topic.forwarded == []
    for _ in range(3):
        stand.now = stand.mux.due_at
        stand.mux.drain()
    assert stand.topic.forwarded == ["safe"] * 3
    assert (stand.now, stand.report.safe_sent) == (pytest.approx(100.4), 3)
    stand.order(replace(SAFE, epoch=6))
    stand.after(10.0)
    stand.after(0.0, "w-1")
    assert stand.topic.forwarded == ["safe"] * 3 + ["w-1"], "an instance in control may be idle"
    stand.start()
    stand.after(10.0)
    assert stand.topic.forwarded[-1] == "w-1"


def test_safe_commands_are_sent_if_an_instance_whose_silence_counts_is_silent_and_nobody_follows(stand: Stand) -> None:
    standing = replace(SAFE.standing, on_board=OnBoard("home", {"/cmd_vel": 1.0}))
    stand.order(replace(SAFE, standing=standing))
    stand.after(0.0, "w-1")
    stand.after(1.19)
    assert stand.topic.forwarded == ["w-1"]
    stand.after(0.02)
    assert stand.topic.forwarded == ["w-1", "safe"]
    stand.after(0.01, "w-1")
    stand.after(0.5)
    assert stand.topic.forwarded == ["w-1", "safe", "w-1"]


def test_a_safe_command_that_cannot_be_sent_ends_nothing(stand: Stand) -> None:
    standing = replace(SAFE.standing, safe=(SafeCommand("/cmd_vel", {"field": "wrong"}, 0.1),))
    stand.order(replace(SAFE, source="", standing=standing))
    stand.after(1.0)
    stand.after(1.0)
    assert (stand.topic.forwarded, stand.report.safe_sent) == ([], 0)


def test_a_mux_that_restarts_follows_its_standing_order(stand: Stand) -> None:
    standing = replace(
        SAFE.standing, successors=("w-2",), silences={"/cmd_vel": 0.5}, on_board=OnBoard("home", {"/cmd_vel": 1.0})
    )
    stand.order(replace(SAFE, standing=standing))
    stand.start()
    assert stand.mux.control.standing == standing


def test_a_process_that_stood_still_hears_first_what_arrived_meanwhile(stand: Stand) -> None:
    stand.order(ORDER)
    stand.after(0.1, "w-1", "w-2")
    stand.after(5.0, "w-1", "w-2")
    assert stand.report.source == "w-1"


def test_a_mux_that_restarts_goes_on_and_refuses_older_orders(stand: Stand) -> None:
    stand.order(ORDER)
    stand.order(replace(ORDER, epoch=6, source="w-2"))
    stand.start()
    stand.after(0.01, "w-1", "w-2")
    assert stand.topic.forwarded == ["w-2"]
    assert "of epoch 5" in stand.order(ORDER).refused
    assert stand.report.source == "w-2"


def test_an_order_that_cannot_be_kept_fences_and_puts_nobody_in_control(stand: Stand, tmp_path: Path) -> None:
    stand.order(ORDER)
    (tmp_path / "control.json.new").mkdir()
    report = stand.order(replace(ORDER, epoch=6, source="w-2"), "later")
    assert (report.source, report.nonce) == ("", "later"), (
        "the order fences the first one, and the second one is not kept"
    )
    assert "cannot keep it" in report.refused
    stand.after(1.0, "w-1", "w-2")
    assert stand.topic.forwarded == []
    stand.start()
    assert stand.report.source == "w-1", "the next order comes soon"
    stand.order(replace(ORDER, epoch=6, source=""))
    assert stand.report.source == ""
    (tmp_path / "control.json.new").rmdir()
    stand.order(replace(ORDER, epoch=6, source="w-2"))
    stand.after(0.01, "w-1", "w-2")
    assert stand.topic.forwarded == ["w-2"]


@pytest.mark.parametrize("source", ["w-1", ""])
def test_after_a_fence_that_cannot_be_kept_the_instance_on_board_does_not_stand_in(
    stand: Stand, tmp_path: Path, source: str
) -> None:
    """Somebody may stand in front of the robot (seed 3252407)."""
    standing = StandingOrder(on_board=OnBoard("w-2", {"/cmd_vel": 1.0}))
    stand.order(replace(ORDER, source=source, standing=standing))
    (tmp_path / "control.json.new").mkdir()
    fence = replace(ORDER, epoch=6, source="", standing=StandingOrder())
    assert "cannot keep it" in stand.order(fence).refused
    (tmp_path / "control.json.new").rmdir()
    stand.after(5.0, "w-2")
    stand.after(5.0, "w-2")
    assert (stand.report.source, stand.topic.forwarded) == ("", [])
    assert not stand.order(fence, "again").refused
    assert stand.mux.control.token == Token(1000.0, 6)


def test_an_order_that_cannot_be_kept_does_not_stop_the_instance_that_it_names(stand: Stand, tmp_path: Path) -> None:
    stand.order(ORDER)
    (tmp_path / "control.json.new").mkdir()
    assert "cannot keep it" in stand.order(replace(ORDER, epoch=6)).refused
    stand.after(0.01, "w-1")
    assert stand.topic.forwarded == ["w-1"]


def test_an_order_that_cannot_be_kept_ends_all_older_ones(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "control.json.new").mkdir()
    fence = replace(ORDER, epoch=6, source="")
    assert "cannot keep it" in stand.order(fence).refused
    (tmp_path / "control.json.new").rmdir()
    report = stand.order(ORDER, "late")
    assert (report.source, report.nonce) == ("", "late")
    assert "epoch 6" in report.refused
    assert not stand.order(fence, "again").refused
    assert stand.mux.control.token == Token(1000.0, 6)


def test_a_switch_that_cannot_be_kept_is_not_made(stand: Stand, tmp_path: Path) -> None:
    stand.order(ORDER)
    stand.after(0.1, "w-1")
    (tmp_path / "control.json.new").mkdir()
    stand.after(1.0, "w-2")
    assert stand.report.source == "w-1"
    (tmp_path / "control.json.new").rmdir()
    stand.after(0.01, "w-2")
    assert stand.report.source == "w-2"


def test_an_instance_is_not_replaced_before_a_mux_that_has_just_started_can_have_discovered_it(stand: Stand) -> None:
    stand.order(ORDER)
    stand.start()
    stand.after(1.0, "w-2")
    assert stand.report.source == "w-1", "it may send all the time"
    stand.after(1.6, "w-2")
    assert stand.report.source == "w-2"


def test_a_damaged_file_is_moved_aside_and_nobody_is_forwarded(stand: Stand, tmp_path: Path) -> None:
    stand.order(ORDER)
    (tmp_path / "control.json").write_text("{}")
    stand.start()
    assert stand.mux.control == Control()
    assert (tmp_path / "control.damaged").exists()


def test_the_report_says_whom_the_robot_receives_since_when_and_who_else_is_heard(stand: Stand) -> None:
    report = stand.order(ORDER, "n-1")
    assert (report.source, report.nonce, report.refused, report.forwarded, report.since) == (
        "w-1",
        "n-1",
        "",
        0,
        math.inf,
    )
    stand.after(0.1, "w-1", "w-2")
    stand.after(0.2, "w-1")
    report = stand.report
    assert (report.forwarded, report.since) == (2, pytest.approx(0.2))
    assert report.heard == {"w-1": {"/cmd_vel": 0.0}, "w-2": {"/cmd_vel": pytest.approx(0.2)}}


def test_an_order_of_somebody_else_is_ignored(stand: Stand) -> None:
    stand.mux.order(order_text(ORDER, "n", derive(b"other", "fleet", "w")))
    assert stand.report.source == ""
    assert stand.report.nonce == ""


def test_a_mux_carries_out_orders_that_name_it_and_forwards_nobody_after_one_for_another(tmp_path: Path) -> None:
    stand = Stand(tmp_path, identity="m-1")
    report = stand.order(ORDER)
    assert (report.mux, report.nonce, report.source) == ("m-1", "n", ""), "the monitor learns which mux there is"
    assert stand.order(replace(ORDER, mux="m-1")).source == "w-1"
    assert "older than what this one has carried out" in stand.order(replace(ORDER, epoch=4, mux="m-2")).refused
    assert stand.report.source == "w-1"
    assert stand.order(replace(ORDER, mux="m-2")).source == ""
    stand.start()
    stand.after(0.1, "w-1")
    assert stand.topic.forwarded == [], "also after a restart"
    assert stand.order(replace(ORDER, mux="m-1")).source == "w-1", "the other one is gone"
