"""Who the samples on the outputs are attributed to, also after a pod's object is gone and after a restart of the monitor."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import pytest

from tests.support.clock import set_clock
from understudy.failover.interfaces import Instance
from understudy.failover.pinned import PinnedPod
from understudy.monitor.observe.robot.known_senders import REMEMBERED, SILENT_FOR, KnownSender, KnownSenders

NOW = 1_000_000.0
FORMER = Instance("w-1", "uid-1", ip="10.0.0.1")
ACTIVE = Instance("w-2", "uid-2", ip="10.0.0.2")
PIN = PinnedPod(name="w-1", uid="uid-1", ip="10.0.0.1")


def updated(
    senders: KnownSenders,
    now: float,
    *instances: Instance,
    pinned: Sequence[PinnedPod] = (),
    heard: Mapping[str, float] | None = None,
) -> Mapping[str, KnownSender]:
    senders.update(instances, pinned, (heard or {}).get, now)
    return senders.named()


def test_an_instance_that_was_never_let_through_is_forgotten_a_minute_after_its_object() -> None:
    senders = KnownSenders()
    updated(senders, NOW, FORMER, ACTIVE)
    assert "w-1" in updated(senders, NOW + REMEMBERED - 1, ACTIVE)
    assert "w-1" not in updated(senders, NOW + REMEMBERED, ACTIVE)


def test_an_instance_that_was_let_through_stays_known_until_it_was_silent_for_long_enough() -> None:
    senders = KnownSenders()
    updated(senders, NOW, FORMER, ACTIVE, pinned=[PIN])
    heard = NOW + 2 * REMEMBERED
    known = updated(senders, heard, ACTIVE, pinned=[PIN], heard={"10.0.0.1": heard})["w-1"]
    assert (known.listed, known.pinned, known.attributed) == (False, True, True)
    known = updated(senders, heard + SILENT_FOR - 1, ACTIVE, pinned=[PIN], heard={"10.0.0.1": heard})["w-1"]
    assert not known.attributed, "after a minute of silence, only what it sends on outputs is"
    assert "w-1" not in updated(senders, heard + SILENT_FOR, ACTIVE, pinned=[PIN], heard={"10.0.0.1": heard})
    assert "w-1" not in updated(senders, heard + SILENT_FOR + 1, ACTIVE, pinned=[PIN]), "and it does not come back"


def test_a_new_monitor_knows_a_vanished_instance_that_was_let_through() -> None:
    senders = KnownSenders()
    known = updated(senders, NOW, ACTIVE, pinned=[PIN])["w-1"]
    assert (known.uid, known.attributed) == ("uid-1", False)
    assert updated(senders, NOW + 1, ACTIVE, pinned=[PIN], heard={"10.0.0.1": NOW + 1})["w-1"].attributed


def test_a_successor_of_the_same_name_does_not_hide_the_instance_before_it() -> None:
    senders = KnownSenders()
    updated(senders, NOW, FORMER, pinned=[PIN])
    known = updated(senders, NOW + 1, Instance("w-1", "uid-3", ip="10.0.0.3"), pinned=[PIN])
    assert {name: sender.uid for name, sender in known.items()} == {"w-1": "uid-3", "w-1 (uid-1)": "uid-1"}


def test_an_address_that_a_new_instance_has_is_no_longer_that_of_the_old_one() -> None:
    senders = KnownSenders()
    updated(senders, NOW, FORMER, pinned=[PIN])
    successor = Instance("w-3", "uid-3", ip="10.0.0.1")
    later = NOW + REMEMBERED
    known = updated(senders, later, successor, pinned=[PIN], heard={"10.0.0.1": later})
    assert list(known) == ["w-3"], "samples from there are the successor's"


@pytest.mark.parametrize("step", [3600.0, -3600.0], ids=["forward", "back"])
def test_a_step_of_the_clock_neither_hides_nor_keeps_an_instance_that_is_gone(
    monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    senders = KnownSenders()
    begun = time.time()
    updated(senders, begun, FORMER, ACTIVE, pinned=[PIN])
    heard = {"10.0.0.1": begun + 90}
    assert updated(senders, begun + 100, ACTIVE, pinned=[PIN], heard=heard)["w-1"].attributed
    set_clock(monkeypatch, step)
    # The record of the samples is moved only after this update.
    assert updated(senders, begun + step + 101, ACTIVE, pinned=[PIN], heard=heard)["w-1"].attributed
    moved = {"10.0.0.1": heard["10.0.0.1"] + step}
    kept = updated(senders, begun + step + 90 + SILENT_FOR - 1, ACTIVE, pinned=[PIN], heard=moved)
    assert not kept["w-1"].attributed
    late = begun + step + 101 + SILENT_FOR
    assert "w-1" not in updated(senders, late, ACTIVE, pinned=[PIN], heard=moved)
