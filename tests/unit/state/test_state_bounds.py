"""How many versions are kept, and how much they may take."""

from __future__ import annotations

import itertools
import math

from tests.unit.state.keepers import MAP, POSE, START, TICK, TYPE, healthy, offer, state, total
from understudy.api.kinds.state_spec import State
from understudy.api.protocol.kept_state import LARGEST
from understudy.state.state_capture import LAG, SPREAD, SQUEEZED, Keeper


def test_few_versions_are_kept_and_spread_over_the_maximum_age() -> None:
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10m"}], "period": "200ms"}))
    healthy(keeper, START, START + 1200, every=0.1)
    now = START + 1200
    versions = keeper.versions()[POSE]
    assert len(versions) < 4 + 2 * math.log(600 / 0.2) / math.log(1 + SPREAD)
    for older, newer in itertools.pairwise(versions):
        assert newer.good_from - older.good_from <= max(0.2, SPREAD * (now - newer.good_from)) + 0.2 + 1e-6
    assert now - versions[0].taken_at >= 600, "one that is too old stays, so that its age can be told"
    assert now - versions[1].taken_at <= 600


def test_versions_are_at_least_the_period_apart_except_the_last() -> None:
    keeper = Keeper(state(period="500ms"))
    healthy(keeper, START, START + 30, every=0.02)
    times = [version.good_from for version in keeper.versions()[POSE]]
    assert all(b - a >= 0.5 for a, b in itertools.pairwise(times[:-1]))


def test_all_kept_messages_fit_into_max_bytes_at_any_time() -> None:
    topics = [{"topic": "/amcl_pose"}, {"topic": "/map"}]
    keeper = Keeper(State.model_validate({"keep": topics, "maxBytes": 10_000, "period": "200ms"}))
    keeper.judge("Healthy", START)
    for i in range(1, 1200):
        now = START + i * TICK
        offer(keeper, now, f"{now:.3f}".encode().ljust(300))
        offer(keeper, now, f"{now:.3f}".encode().ljust(2000), MAP)
        keeper.judge("Healthy", now)
        assert total(keeper) <= 10_000
        if now > START + 2 * LAG + 5:
            kept = keeper.select(now)
            assert {sample.topic for sample in kept.samples} == {"/amcl_pose", "/map"}
            assert all(now - sample.taken_at < 3 * LAG for sample in kept.samples), "what can be given is renewed"


def test_with_room_for_two_versions_one_is_always_available_and_renewed() -> None:
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/map"}], "maxBytes": 5000}))
    keeper.judge("Healthy", START)
    for i in range(1, 2000):
        now = START + i * TICK
        offer(keeper, now, f"{now:.3f}".encode().ljust(2400), MAP)
        keeper.judge("Healthy", now)
        if now > START + 1:
            (sample,) = keeper.select(now).samples
            assert now - sample.taken_at < 2 * LAG + 2
    assert [entry.trouble for entry in keeper.entries(now)] == ["TooBig"]


def test_a_message_larger_than_max_bytes_is_reported_and_not_kept() -> None:
    keeper = Keeper(state(maxBytes=2000))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"x" * 2001)
    keeper.judge("Healthy", START + 1)
    assert not keeper.versions()
    (entry,) = keeper.entries(START + 1)
    assert entry.trouble == "TooBig"
    assert "2001 bytes" in entry.message
    assert "2000" in entry.message
    offer(keeper, START + 2, b"x" * 20)
    keeper.judge("Healthy", START + 2)
    assert keeper.entries(START + 2)[0].trouble == "TooBig", "it doesn't come and go with each message"
    offer(keeper, START + 3 + SQUEEZED, b"y" * 20)
    keeper.judge("Healthy", START + 3 + SQUEEZED)
    assert keeper.entries(START + 4 + SQUEEZED)[0].trouble is None


def test_a_message_that_is_too_large_for_an_agent_is_not_kept() -> None:
    keeper = Keeper(state(maxBytes=2 * LARGEST))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"x" * (LARGEST + 1))
    keeper.judge("Healthy", START + 1)
    assert not keeper.versions()
    assert keeper.entries(START + 1)[0].trouble == "TooBig"


def test_a_new_message_does_not_displace_the_only_version_of_another_topic() -> None:
    topics = [{"topic": "/amcl_pose"}, {"topic": "/map"}]
    keeper = Keeper(State.model_validate({"keep": topics, "maxBytes": 2000}))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"m" * 1900, MAP)
    keeper.judge("Healthy", START + 1)
    offer(keeper, START + 2, b"p" * 300)
    keeper.judge("Healthy", START + 2)
    assert set(keeper.versions()) == {MAP}
    assert {entry.key: entry.trouble for entry in keeper.entries(START + 2)} == {POSE: "TooBig", MAP: None}


def test_a_repeated_message_takes_no_additional_space() -> None:
    keeper = Keeper(state(maxBytes=2000))
    keeper.judge("Healthy", START)
    for i in range(1, 300):
        offer(keeper, START + i, b"same".ljust(1500))
        keeper.judge("Healthy", START + i)
    assert keeper.entries(START + 300)[0].trouble is None
    (sample,) = keeper.select(START + 299).samples
    assert START + 290 < sample.taken_at <= START + 298.5


def test_a_message_repeated_for_a_late_joiner_is_not_new() -> None:
    keeper = Keeper(state())
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"pose", standing="instance")
    keeper.judge("Healthy", START + 1)
    before = keeper.versions()
    keeper.offer(POSE, b"pose", taken_at=START + 0.999, received_at=START + 50, type=TYPE, standing="instance")
    keeper.judge("Healthy", START + 50)
    assert keeper.versions() == before


def test_topics_are_kept_separately() -> None:
    topics = [
        {"topic": "/amcl_pose", "restoreTo": "/initialpose", "stamp": "now", "confirm": "/amcl_pose"},
        {"topic": "/map"},
    ]
    keeper = Keeper(State.model_validate({"keep": topics}))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"pose")
    offer(keeper, START + 1, b"map", MAP)
    keeper.judge("Healthy", START + 1)
    pose, chart = keeper.select(START + 2).samples
    assert (pose.topic, pose.to, pose.stamp, pose.confirm, pose.data, pose.type) == (
        "/amcl_pose",
        "/initialpose",
        "now",
        "/amcl_pose",
        b"pose",
        TYPE,
    )
    assert (chart.topic, chart.to, chart.stamp, chart.data) == ("/map", "", "kept", b"map")
