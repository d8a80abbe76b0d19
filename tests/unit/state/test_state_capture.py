"""Which sample is the last healthy one, and what bounds all that is kept."""

from __future__ import annotations

import itertools
import json
import math

import pytest

from tests.support.golden import assert_golden
from understudy.api.kinds.state_spec import State
from understudy.api.protocol.kept_state import LARGEST
from understudy.state.state_capture import LAG, PATIENCE, SPREAD, SQUEEZED, Keeper, Key, Standing, Version

POSE = Key("Topic", "/amcl_pose")
MAP = Key("Topic", "/map")
TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
START = 1_000_000.0
TICK = 0.05


def state(**fields: object) -> State:
    return State.model_validate(
        {"keep": [{"topic": "/amcl_pose", "restoreTo": "/initialpose", "stamp": "now"}]} | fields
    )


def offer(keeper: Keeper, at: float, data: bytes = b"", key: Key = POSE, *, standing: Standing = "") -> None:
    keeper.offer(key, data or repr(at).encode(), taken_at=at, received_at=at, type=TYPE, standing=standing)


def healthy(keeper: Keeper, start: float, end: float, *, every: float = TICK) -> None:
    """The tree holds from the first moment to the last, and a message comes just before each look."""
    for i in range(round((end - start) / every) + 1):
        now = start + i * every
        if i:
            offer(keeper, now)
        keeper.judge("Healthy", now)


def given(keeper: Keeper, onset: float) -> float:
    (sample,) = keeper.select(onset).samples
    assert sample.data == repr(sample.taken_at).encode()
    return sample.taken_at


def reason(keeper: Keeper, onset: float) -> str:
    kept = keeper.select(onset)
    assert not kept.samples
    (left,) = kept.left_out
    assert not left.failed
    return left.reason


# -- which one is chosen ----------------------------------------------------------------------------------------------


def test_the_newest_from_before_the_margin_is_given() -> None:
    keeper = Keeper(state(margin="500ms", period="200ms"))
    healthy(keeper, START, START + 10)
    taken = given(keeper, START + 10)
    assert START + 10 - 0.5 - 0.2 - 2 * TICK <= taken <= START + 10 - 0.5


@pytest.mark.parametrize("lag", [0.0, 0.3, 1.0, 2.7, 5.0, 20.0])
def test_never_one_from_within_the_margin_however_late_the_failure_is_noticed(lag: float) -> None:
    keeper = Keeper(state(margin="500ms", period="200ms"))
    healthy(keeper, START, START + 60)
    onset = START + 60 - lag
    taken = given(keeper, onset)
    assert taken <= onset - 0.5
    wanted = lag + 0.5
    assert onset - 0.5 - taken <= max(0.2, SPREAD * wanted) + 2 * TICK, "the chosen one is hardly older than asked for"


def test_what_came_while_the_tree_failed_is_never_given() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    for i in range(40):
        offer(keeper, START + 5.05 + i * TICK)
        keeper.judge("Failed", START + 5.05 + i * TICK)
    assert given(keeper, START + 7) <= START + 5
    healthy(keeper, START + 7.05, START + 9)
    times = [version.taken_at for version in keeper.versions()[POSE]]
    assert not [time for time in times if START + 5 < time <= START + 7.05]


def test_what_came_while_the_instance_started_is_not_kept() -> None:
    keeper = Keeper(state())
    for i in range(20):
        offer(keeper, START + i * TICK)
        keeper.judge("Starting", START + i * TICK)
    keeper.judge("Healthy", START + 1)
    assert "no message" in reason(keeper, START + 60)


def test_what_came_before_the_first_healthy_look_is_not_kept() -> None:
    keeper = Keeper(state())
    offer(keeper, START - 0.01)
    keeper.judge("Healthy", START)
    assert not keeper.versions()


def test_what_stands_when_the_instance_is_first_healthy_counts_from_then_on() -> None:
    keeper = Keeper(state())
    offer(keeper, START, b"latched", standing="instance")
    keeper.judge("Starting", START + 0.1)
    keeper.judge("Starting", START + 2)
    keeper.judge("Healthy", START + 3)
    assert "within the margin" in reason(keeper, START + 3.4)
    (sample,) = keeper.select(START + 3.5).samples
    assert (sample.data, sample.taken_at) == (b"latched", START), "its age is that of the message"


def test_what_stands_and_came_while_the_tree_failed_is_not_kept() -> None:
    keeper = Keeper(state())
    offer(keeper, START, standing="instance")
    keeper.judge("Failed", START + 0.1)
    keeper.judge("Healthy", START + 0.2)
    assert not keeper.versions()


def test_what_the_robot_holds_counts_for_the_next_instance_too() -> None:
    """A map that the robot said once, before anyone was in control, and while the one that was failed."""
    keeper = Keeper(state())
    offer(keeper, START, b"latched", standing="robot")
    keeper.forget_offers()
    keeper.judge("Starting", START + 1)
    keeper.judge("Failed", START + 2)
    keeper.judge("Healthy", START + 3)
    (sample,) = keeper.select(START + 4).samples
    assert (sample.data, sample.taken_at) == (b"latched", START)


def test_only_the_last_message_of_a_burst_stays() -> None:
    """A robot that stops says its last pose once, however shortly after the one before."""
    keeper = Keeper(state(period="200ms"))
    keeper.judge("Healthy", START)
    for at in (1.0, 1.05, 1.1):
        offer(keeper, START + at)
        keeper.judge("Healthy", START + at)
    keeper.judge("Healthy", START + 30)
    assert given(keeper, START + 30) == START + 1.1


def test_another_instance_in_control_starts_anew_and_the_old_state_stays() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    last = given(keeper, START + 5)
    offer(keeper, START + 5.02)
    keeper.forget_offers()
    assert keeper.healthy_since is None
    keeper.judge("Healthy", START + 6)
    assert given(keeper, START + 6.4) <= START + 5
    assert given(keeper, START + 5) == last


def test_a_second_failure_before_anything_new_is_good_gives_the_same_state() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    first = given(keeper, START + 5)
    keeper.forget_offers()
    healthy(keeper, START + 6, START + 6.3)
    assert given(keeper, START + 6.3) <= START + 5
    assert given(keeper, START + 5) == first


# -- age --------------------------------------------------------------------------------------------------------------


def test_a_message_older_than_max_age_is_reported_and_not_given() -> None:
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10s"}]}))
    healthy(keeper, START, START + 5)
    assert given(keeper, START + 14) <= START + 5
    assert_golden("kept_state", reason(keeper, START + 15.1), "10.1 s", "10s")
    keeper.judge("Healthy", START + 30)
    (entry,) = keeper.entries(START + 30)
    assert (entry.trouble, entry.taken_at) == ("TooOld", pytest.approx(START + 5))
    assert "/amcl_pose" in entry.message
    assert "older than maxAge (10s)" in entry.message


def test_the_age_counts_from_the_beginning_of_the_failure() -> None:
    """A failure that takes long to be dealt with doesn't cost the state."""
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10s"}]}))
    healthy(keeper, START, START + 5)
    for i in range(100):
        keeper.judge("Failed", START + 5 + i)
    assert given(keeper, START + 5) <= START + 4.5


def test_a_topic_that_never_comes_is_told_after_a_while_of_health() -> None:
    keeper = Keeper(state())
    keeper.judge("Healthy", START)
    assert keeper.entries(START + PATIENCE)[0].trouble is None
    (entry,) = keeper.entries(START + PATIENCE + 0.1)
    assert entry.trouble == "NeverCame"
    assert entry.message.startswith("/amcl_pose: no message came")


def test_a_topic_that_never_comes_is_not_told_of_an_instance_that_is_not_healthy() -> None:
    keeper = Keeper(state())
    keeper.judge("Starting", START)
    assert keeper.entries(START + 10 * PATIENCE)[0].trouble is None


def test_what_is_noted_about_a_topic_is_told_instead() -> None:
    keeper = Keeper(state())
    keeper.note({POSE: ("NotWatched", "/amcl_pose: foo/msg/Bar is not installed")})
    (entry,) = keeper.entries(START)
    assert (entry.trouble, entry.message) == ("NotWatched", "/amcl_pose: foo/msg/Bar is not installed")
    assert reason(keeper, START) == "foo/msg/Bar is not installed"


def test_why_a_topic_never_came_is_told_when_patience_ends_and_given_as_the_reason_at_once() -> None:
    keeper = Keeper(state())
    keeper.note({POSE: ("NeverCame", "/amcl_pose: nobody publishes it")})
    keeper.judge("Healthy", START)
    assert keeper.entries(START + 1)[0].trouble is None
    assert reason(keeper, START + 1) == "nobody publishes it"
    (entry,) = keeper.entries(START + PATIENCE + 1)
    assert (entry.trouble, entry.message) == ("NeverCame", "/amcl_pose: nobody publishes it")
    offer(keeper, START + 20)
    keeper.judge("Healthy", START + 20)
    assert keeper.entries(START + 21)[0].trouble is None


# -- how many and how much ---------------------------------------------------------------------------------------------


def test_versions_are_few_and_spread_over_the_age() -> None:
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10m"}], "period": "200ms"}))
    healthy(keeper, START, START + 1200, every=0.1)
    now = START + 1200
    versions = keeper.versions()[POSE]
    assert len(versions) < 4 + 2 * math.log(600 / 0.2) / math.log(1 + SPREAD)
    for older, newer in itertools.pairwise(versions):
        assert newer.good_from - older.good_from <= max(0.2, SPREAD * (now - newer.good_from)) + 0.2 + 1e-6
    assert now - versions[0].taken_at >= 600, "one that is too old stays, so that its age can be told"
    assert now - versions[1].taken_at <= 600


def test_no_two_versions_are_nearer_than_the_period_but_the_last() -> None:
    keeper = Keeper(state(period="500ms"))
    healthy(keeper, START, START + 30, every=0.02)
    times = [version.good_from for version in keeper.versions()[POSE]]
    assert all(b - a >= 0.5 for a, b in itertools.pairwise(times[:-1]))


def total(keeper: Keeper) -> int:
    """Bytes of the texts that are held, each once."""
    return sum(
        len(data)
        for versions in keeper.versions().values()
        for data in {id(version.data): version.data for version in versions}.values()
    )


def test_all_that_is_kept_fits_into_max_bytes_at_any_time() -> None:
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


def test_with_room_for_two_only_there_is_always_one_to_give_and_it_is_renewed() -> None:
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


def test_a_message_that_is_bigger_than_all_is_told_and_not_kept() -> None:
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


def test_a_message_that_no_agent_could_be_sent_is_not_kept() -> None:
    keeper = Keeper(state(maxBytes=2 * LARGEST))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"x" * (LARGEST + 1))
    keeper.judge("Healthy", START + 1)
    assert not keeper.versions()
    assert keeper.entries(START + 1)[0].trouble == "TooBig"


def test_what_comes_last_does_not_push_out_the_only_version_of_another_topic() -> None:
    topics = [{"topic": "/amcl_pose"}, {"topic": "/map"}]
    keeper = Keeper(State.model_validate({"keep": topics, "maxBytes": 2000}))
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"m" * 1900, MAP)
    keeper.judge("Healthy", START + 1)
    offer(keeper, START + 2, b"p" * 300)
    keeper.judge("Healthy", START + 2)
    assert set(keeper.versions()) == {MAP}
    assert {entry.key: entry.trouble for entry in keeper.entries(START + 2)} == {POSE: "TooBig", MAP: None}


def test_the_same_message_again_takes_no_room() -> None:
    keeper = Keeper(state(maxBytes=2000))
    keeper.judge("Healthy", START)
    for i in range(1, 300):
        offer(keeper, START + i, b"same".ljust(1500))
        keeper.judge("Healthy", START + i)
    assert keeper.entries(START + 300)[0].trouble is None
    (sample,) = keeper.select(START + 299).samples
    assert START + 290 < sample.taken_at <= START + 298.5


def test_what_is_given_to_a_late_joiner_again_is_nothing_new() -> None:
    keeper = Keeper(state())
    keeper.judge("Healthy", START)
    offer(keeper, START + 1, b"pose", standing="instance")
    keeper.judge("Healthy", START + 1)
    before = keeper.versions()
    keeper.offer(POSE, b"pose", taken_at=START + 0.999, received_at=START + 50, type=TYPE, standing="instance")
    keeper.judge("Healthy", START + 50)
    assert keeper.versions() == before


def test_topics_are_kept_each_for_itself() -> None:
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


def test_parameters_and_lifecycle_states_are_given_as_they_were() -> None:
    keeper = Keeper(
        State.model_validate(
            {"parameters": [{"node": "/controller", "names": ["speed"]}], "lifecycle": ["/map_server"]}
        )
    )
    keeper.judge("Healthy", START)
    for at, speed, now in ((1, 0.3, "active"), (5, 0.9, "inactive")):
        keeper.offer(
            Key("Parameters", "/controller"),
            json.dumps({"speed": speed}).encode(),
            taken_at=START + at,
            received_at=START + at + 0.1,
        )
        keeper.offer(Key("Lifecycle", "/map_server"), now.encode(), taken_at=START + at, received_at=START + at + 0.1)
        keeper.judge("Healthy", START + at + 0.1)
    kept = keeper.select(START + 5.2)
    assert [(p.node, p.values, p.taken_at) for p in kept.parameters] == [("/controller", {"speed": 0.3}, START + 1)]
    assert [(n.node, n.state) for n in kept.lifecycle] == [("/map_server", "active")]
    kept = keeper.select(START + 6)
    assert kept.parameters[0].values == {"speed": 0.9}
    assert kept.lifecycle[0].state == "inactive"
    assert keeper.select(START + 100_000).parameters, "parameters don't grow old"


# -- over time --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
def test_a_step_of_the_clock_changes_no_age(step: float) -> None:
    keeper = Keeper(state(margin="500ms"))
    healthy(keeper, START, START + 10)
    before = given(keeper, START + 10)
    keeper.shift(step)
    (sample,) = keeper.select(START + 10 + step).samples
    assert sample.taken_at == pytest.approx(before + step)
    now = START + 10.05 + step
    offer(keeper, now)
    keeper.judge("Healthy", now)
    assert keeper.versions()[POSE][-1].taken_at == now, "it goes on keeping"


def test_what_an_earlier_monitor_kept_is_taken_up() -> None:
    earlier = Keeper(state())
    healthy(earlier, START, START + 20)
    later = Keeper(state())
    later.adopt(earlier.versions(), START + 21)
    assert later.select(START + 18) == earlier.select(START + 18)
    assert later.healthy_since is None


def test_what_was_kept_for_another_policy_is_not_taken_up() -> None:
    earlier = Keeper(state())
    healthy(earlier, START, START + 5)
    other_topic = Keeper(State.model_validate({"keep": [{"topic": "/odom"}]}))
    other_topic.adopt(earlier.versions(), START + 6)
    other_type = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "type": "geometry_msgs/msg/Pose"}]}))
    other_type.adopt(earlier.versions(), START + 6)
    assert not other_topic.versions()
    assert not other_type.versions()


def test_versions_from_the_future_are_not_taken_up() -> None:
    keeper = Keeper(state())
    keeper.adopt({POSE: [Version(START + 5, START + 5, b"x", TYPE), Version(START - 5, START - 5, b"y", TYPE)]}, START)
    assert [version.data for version in keeper.versions()[POSE]] == [b"y"]


def test_a_changed_policy_keeps_what_it_still_names() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    keeper.follow(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "5m"}, {"topic": "/map"}]}))
    assert given(keeper, START + 5) <= START + 4.5
    assert set(keeper.keys) == {POSE, MAP}
    keeper.follow(State.model_validate({"keep": [{"topic": "/map"}]}))
    assert not keeper.versions()


def test_a_smaller_bound_holds_at_once() -> None:
    keeper = Keeper(state(maxBytes=10_000))
    keeper.judge("Healthy", START)
    for i in range(1, 50):
        offer(keeper, START + i, repr(i).encode().ljust(1500))
        keeper.judge("Healthy", START + i)
    keeper.follow(state(maxBytes=2000))
    assert total(keeper) <= 2000


def test_nothing_to_keep_is_nothing_to_give() -> None:
    keeper = Keeper(State())
    keeper.judge("Healthy", START)
    kept = keeper.select(START + 10)
    assert not kept
    assert not kept.left_out
    assert not keeper.entries(START)
