"""Which sample is the last healthy one, and what bounds all that is kept."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from tests.unit.state.keepers import MAP, POSE, START, TICK, TYPE, healthy, kept_at, offer, reason, state, total
from understudy.api.kinds.state_spec import State
from understudy.state.state_capture import PATIENCE, SPREAD, Keeper, Key, Version

# -- which one is chosen ----------------------------------------------------------------------------------------------


def test_the_newest_message_before_the_margin_is_given() -> None:
    keeper = Keeper(state(margin="500ms", period="200ms"))
    healthy(keeper, START, START + 10)
    taken = kept_at(keeper, START + 10)
    assert START + 10 - 0.5 - 0.2 - 2 * TICK <= taken <= START + 10 - 0.5


@pytest.mark.parametrize("lag", [0.0, 0.3, 1.0, 2.7, 5.0, 20.0])
def test_a_message_within_the_margin_is_never_given(lag: float) -> None:
    keeper = Keeper(state(margin="500ms", period="200ms"))
    healthy(keeper, START, START + 60)
    onset = START + 60 - lag
    taken = kept_at(keeper, onset)
    assert taken <= onset - 0.5
    wanted = lag + 0.5
    assert onset - 0.5 - taken <= max(0.2, SPREAD * wanted) + 2 * TICK, "the chosen one is hardly older than asked for"


def test_messages_received_while_the_tree_failed_are_never_given() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    for i in range(40):
        offer(keeper, START + 5.05 + i * TICK)
        keeper.judge("Failed", START + 5.05 + i * TICK)
    assert kept_at(keeper, START + 7) <= START + 5
    healthy(keeper, START + 7.05, START + 9)
    times = [version.taken_at for version in keeper.versions()[POSE]]
    assert not [time for time in times if START + 5 < time <= START + 7.05]


def test_messages_received_during_the_start_are_not_kept() -> None:
    keeper = Keeper(state())
    for i in range(20):
        offer(keeper, START + i * TICK)
        keeper.judge("Starting", START + i * TICK)
    keeper.judge("Healthy", START + 1)
    assert "no message" in reason(keeper, START + 60)


def test_messages_received_before_the_first_healthy_evaluation_are_not_kept() -> None:
    keeper = Keeper(state())
    offer(keeper, START - 0.01)
    keeper.judge("Healthy", START)
    assert not keeper.versions()


def test_a_latched_message_counts_from_the_first_healthy_evaluation() -> None:
    keeper = Keeper(state())
    offer(keeper, START, b"latched", standing="instance")
    keeper.judge("Starting", START + 0.1)
    keeper.judge("Starting", START + 2)
    keeper.judge("Healthy", START + 3)
    assert "state.margin" in reason(keeper, START + 3.4)
    (sample,) = keeper.select(START + 3.5).samples
    assert (sample.data, sample.taken_at) == (b"latched", START), "its age is that of the message"


def test_a_latched_message_received_while_the_tree_failed_is_not_kept() -> None:
    keeper = Keeper(state())
    offer(keeper, START, standing="instance")
    keeper.judge("Failed", START + 0.1)
    keeper.judge("Healthy", START + 0.2)
    assert not keeper.versions()


def test_a_latched_message_of_the_robot_counts_for_the_next_instance_too() -> None:
    """A map that the robot said once, before anyone was in control, and while the one that was failed."""
    keeper = Keeper(state())
    offer(keeper, START, b"latched", standing="robot")
    keeper.forget_offers()
    keeper.judge("Starting", START + 1)
    keeper.judge("Failed", START + 2)
    keeper.judge("Healthy", START + 3)
    (sample,) = keeper.select(START + 4).samples
    assert (sample.data, sample.taken_at) == (b"latched", START)


def test_the_last_message_of_a_burst_is_kept() -> None:
    """A robot that stops says its last pose once, however shortly after the one before."""
    keeper = Keeper(state(period="200ms"))
    keeper.judge("Healthy", START)
    for at in (1.0, 1.05, 1.1):
        offer(keeper, START + at)
        keeper.judge("Healthy", START + at)
    keeper.judge("Healthy", START + 30)
    assert kept_at(keeper, START + 30) == START + 1.1


def test_a_new_active_instance_starts_without_messages_and_earlier_state_is_kept() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    last = kept_at(keeper, START + 5)
    offer(keeper, START + 5.02)
    keeper.forget_offers()
    assert keeper.healthy_since is None
    keeper.judge("Healthy", START + 6)
    assert kept_at(keeper, START + 6.4) <= START + 5
    assert kept_at(keeper, START + 5) == last


def test_a_second_failure_before_new_messages_count_gives_the_same_state() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    first = kept_at(keeper, START + 5)
    keeper.forget_offers()
    healthy(keeper, START + 6, START + 6.3)
    assert kept_at(keeper, START + 6.3) <= START + 5
    assert kept_at(keeper, START + 5) == first


# -- age --------------------------------------------------------------------------------------------------------------


def test_a_message_older_than_max_age_is_reported_and_not_given() -> None:
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10s"}]}))
    healthy(keeper, START, START + 5)
    assert kept_at(keeper, START + 14) <= START + 5
    assert_golden("kept_state", reason(keeper, START + 15.1), "10.1 s", "10s")
    keeper.judge("Healthy", START + 30)
    (entry,) = keeper.entries(START + 30)
    assert (entry.trouble, entry.taken_at) == ("TooOld", pytest.approx(START + 5))
    assert "/amcl_pose" in entry.message
    assert "older than maxAge (10s)" in entry.message


def test_the_age_counts_at_the_begin_of_the_failure() -> None:
    """A failure that takes long to be dealt with doesn't cost the state."""
    keeper = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "10s"}]}))
    healthy(keeper, START, START + 5)
    for i in range(100):
        keeper.judge("Failed", START + 5 + i)
    assert kept_at(keeper, START + 5) <= START + 4.5


def test_state_of_the_present_instance_is_awaited_for_some_healthy_time() -> None:
    earlier, keeper = Keeper(state()), Keeper(state(margin="500ms"))
    healthy(earlier, START, START + 20)
    keeper.adopt(earlier.versions(), START + 21)
    keeper.judge("Healthy", START + 22)
    assert keeper.awaited(START + 22 + PATIENCE) == ["/amcl_pose"], "what an earlier monitor kept is older"
    assert not keeper.awaited(START + 22.1 + PATIENCE), "it may never come"
    offer(keeper, START + 23)
    keeper.judge("Healthy", START + 23)
    assert keeper.awaited(START + 23.4) == ["/amcl_pose"], "it is too new to be restored"
    assert not keeper.awaited(START + 23.5)


def test_a_topic_without_messages_is_reported_after_some_healthy_time() -> None:
    keeper = Keeper(state())
    keeper.judge("Healthy", START)
    assert keeper.entries(START + PATIENCE)[0].trouble is None
    (entry,) = keeper.entries(START + PATIENCE + 0.1)
    assert entry.trouble == "NeverCame"
    assert entry.message.startswith("/amcl_pose: no message came")


def test_a_topic_without_messages_is_not_reported_for_an_unhealthy_instance() -> None:
    keeper = Keeper(state())
    keeper.judge("Starting", START)
    assert keeper.entries(START + 10 * PATIENCE)[0].trouble is None


def test_a_problem_noted_for_a_topic_is_reported() -> None:
    keeper = Keeper(state())
    keeper.note({POSE: ("NotWatched", "/amcl_pose: foo/msg/Bar is not installed")})
    (entry,) = keeper.entries(START)
    assert (entry.trouble, entry.message) == ("NotWatched", "/amcl_pose: foo/msg/Bar is not installed")
    assert reason(keeper, START) == "foo/msg/Bar is not installed"


def test_the_reason_for_missing_messages_is_given_at_once_and_reported_later() -> None:
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


def test_parameters_and_lifecycle_states_are_given_as_they_were_at_the_time() -> None:
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
def test_a_clock_step_changes_no_age(step: float) -> None:
    keeper = Keeper(state(margin="500ms"))
    healthy(keeper, START, START + 10)
    before = kept_at(keeper, START + 10)
    keeper.shift(step)
    (sample,) = keeper.select(START + 10 + step).samples
    assert sample.taken_at == pytest.approx(before + step)
    now = START + 10.05 + step
    offer(keeper, now)
    keeper.judge("Healthy", now)
    assert keeper.versions()[POSE][-1].taken_at == now, "it goes on keeping"


def test_state_kept_by_an_earlier_monitor_is_used() -> None:
    earlier = Keeper(state())
    healthy(earlier, START, START + 20)
    later = Keeper(state())
    later.adopt(earlier.versions(), START + 21)
    assert later.select(START + 18) == earlier.select(START + 18)
    assert later.healthy_since is None


def test_only_the_newer_state_of_another_monitor_is_adopted() -> None:
    here, other = Keeper(state()), Keeper(state())
    healthy(here, START, START + 20)
    healthy(other, START + 10.02, START + 30)
    before, revision = kept_at(here, START + 15), here.revision
    here.adopt(other.versions(), START + 30)
    assert kept_at(here, START + 15) == before, "its own state from before the other monitor began stays"
    assert kept_at(here, START + 30) == kept_at(other, START + 30)
    assert here.revision > revision
    for second in range(31, 91):
        healthy(other, START + second - 0.9, START + second)
        here.adopt(other.versions(), START + second)
    assert len(here.versions()[POSE]) <= len(other.versions()[POSE]) + 2, (
        "versions that are close for their age are dropped"
    )


def test_state_kept_for_another_policy_is_not_used() -> None:
    earlier = Keeper(state())
    healthy(earlier, START, START + 5)
    other_topic = Keeper(State.model_validate({"keep": [{"topic": "/odom"}]}))
    other_topic.adopt(earlier.versions(), START + 6)
    other_type = Keeper(State.model_validate({"keep": [{"topic": "/amcl_pose", "type": "geometry_msgs/msg/Pose"}]}))
    other_type.adopt(earlier.versions(), START + 6)
    assert not other_topic.versions()
    assert not other_type.versions()


def test_versions_from_the_future_are_not_used() -> None:
    keeper = Keeper(state())
    keeper.adopt({POSE: [Version(START + 5, START + 5, b"x", TYPE), Version(START - 5, START - 5, b"y", TYPE)]}, START)
    assert [version.data for version in keeper.versions()[POSE]] == [b"y"]


def test_a_changed_policy_keeps_the_topics_that_it_still_names() -> None:
    keeper = Keeper(state())
    healthy(keeper, START, START + 5)
    keeper.follow(State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "5m"}, {"topic": "/map"}]}))
    assert kept_at(keeper, START + 5) <= START + 4.5
    assert set(keeper.keys) == {POSE, MAP}
    keeper.follow(State.model_validate({"keep": [{"topic": "/map"}]}))
    assert not keeper.versions()


def test_a_smaller_max_bytes_applies_at_once() -> None:
    keeper = Keeper(state(maxBytes=10_000))
    keeper.judge("Healthy", START)
    for i in range(1, 50):
        offer(keeper, START + i, repr(i).encode().ljust(1500))
        keeper.judge("Healthy", START + i)
    keeper.follow(state(maxBytes=2000))
    assert total(keeper) <= 2000


def test_a_policy_that_keeps_nothing_gives_no_state() -> None:
    keeper = Keeper(State())
    keeper.judge("Healthy", START)
    kept = keeper.select(START + 10)
    assert not kept
    assert not kept.left_out
    assert not keeper.entries(START)
