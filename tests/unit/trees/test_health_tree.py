"""What a tree says, when, and why; and that its deadline is the exact moment at which it says worse."""

import math
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.unit.trees.topic_world import START, World, gap, rate, steady
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.core.observations import RecordedObservations
from understudy.trees.languages.short.health_loader import load


def test_a_gap_fails_exactly_at_its_length_after_the_last_sample():
    world = World(gap("/cmd_vel")).arrive("/cmd_vel", 1.0)
    assert world.at(1.499999).state == "Healthy"
    assert world.at(1.5) == Verdict("Failed", "no /cmd_vel for 500 ms", "cmd_vel", START + 1.0)


def test_a_topic_without_a_sample_is_starting_until_the_grace_ends():
    world = World(gap("/cmd_vel"), grace=10)
    assert world.at(9.999) == Verdict("Starting", "waiting for the first /cmd_vel, for up to 10 s", "cmd_vel", None)
    assert world.deadline(5) == 10
    assert world.at(10) == Verdict("Failed", "no /cmd_vel within 10 s of the start", "cmd_vel", None)


def test_samples_from_before_the_activation_of_an_instance_do_not_count():
    world = World(gap("/cmd_vel"), since=5).arrive("/cmd_vel", 4.9)
    assert world.at(5.1).state == "Starting"
    assert world.arrive("/cmd_vel", 5.2).at(5.3).state == "Healthy"


def test_a_topic_that_is_not_yet_watched_is_starting():
    tree = load(gap("/cmd_vel"))
    assert tree.evaluate(RecordedObservations({}), now=START, since=START).state == "Starting"


def test_a_rate_below_the_band_is_reported_with_its_value():
    world = World(rate("/scan")).arrive("/scan", *steady(10, 0, 4))
    assert world.at(4).state == "Healthy"
    world.arrive("/scan", 4.2, 4.4, 4.6, 4.8, 5.0)
    assert world.at(5.0).reason == "/scan at 7 Hz, below 8 Hz over 2 s"


def test_a_rate_equal_to_a_strict_bound_does_not_hold():
    world = World(rate("/scan", "> 8 Hz"), grace=0).arrive("/scan", *steady(8, 0, 4))
    assert world.at(3.9).reason == "/scan at 8 Hz, not above 8 Hz over 2 s"


def test_a_rate_fails_at_the_moment_when_the_count_falls_below_the_band():
    world = World(rate("/scan")).arrive("/scan", *steady(10, 0, 4))
    assert world.at(3.95).state == "Healthy"
    # 17 samples are needed in 2 s: those since 2.3; the sample of 2.3 leaves at 4.3.
    assert world.deadline(3.95) == pytest.approx(4.3)
    assert world.at(4.2999).state == "Healthy"
    assert world.at(4.3).state == "Failed"


def test_a_rate_above_the_band_fails_and_recovers_without_a_sample():
    world = World(rate("/scan", "9 to 11 Hz", "1s"), grace=0).arrive("/scan", *steady(10, 0, 3), 2.95, 2.96)
    assert world.at(2.97).reason == "/scan at 12 Hz, above 11 Hz over 1 s"
    assert world.deadline(2.97) is None
    assert world.at(3.1).state == "Healthy"


def test_a_rate_is_starting_until_a_window_has_passed_since_the_first_sample():
    world = World(rate("/scan"), grace=1).arrive("/scan", *steady(10, 0.95, 2.9))
    assert world.at(2.9).state == "Starting"
    world.arrive("/scan", 2.95)
    assert world.at(2.96).state == "Healthy"


def test_a_rate_that_has_never_held_is_starting_until_the_grace_ends():
    world = World(rate("/scan"), grace=10).arrive("/scan", *steady(5, 0, 10))
    assert world.at(6) == Verdict("Starting", "/scan has not had a rate of > 8 Hz for 2 s yet", "scan", None)
    assert world.deadline(6) == 10
    assert world.at(10).state == "Failed"


def test_a_rate_that_has_held_once_has_no_more_grace():
    world = World(rate("/scan"), grace=30).arrive("/scan", *steady(10, 0, 3))
    assert world.at(2.95).state == "Healthy"
    assert world.at(3.5).state == "Failed"


def test_the_next_instance_has_its_own_grace():
    world = World(rate("/scan"), grace=30).arrive("/scan", *steady(10, 0, 3))
    assert world.at(2.95).state == "Healthy"
    world.since = START + 3.5
    assert world.at(3.6).state == "Starting"
    world.arrive("/scan", *steady(5, 4, 8))
    assert world.at(8).state == "Starting"


def test_silence_satisfies_an_upper_bound():
    world = World(rate("/scan", "< 20 Hz"), grace=5)
    assert world.at(4).state == "Starting"
    assert world.at(5).state == "Healthy"


def test_gap_and_rate_of_a_topic_must_both_hold():
    tree = {"topic": {"name": "/scan", "gap": "300ms", "rate": "> 5 Hz", "window": "2s"}}
    world = World(tree).arrive("/scan", *steady(10, 0, 4))
    assert world.at(3.95).state == "Healthy"
    assert world.deadline(3.95) == pytest.approx(4.2)
    assert world.at(4.2).reason == "no /scan for 300 ms"


@pytest.mark.parametrize(
    ("kind", "first", "second", "expected"),
    [
        ("parallel", "Healthy", "Healthy", "Healthy"),
        ("parallel", "Healthy", "Starting", "Starting"),
        ("parallel", "Starting", "Failed", "Failed"),
        ("parallel", "Failed", "Starting", "Failed"),
        ("parallel", "Failed", "Healthy", "Failed"),
        ("selector", "Starting", "Healthy", "Healthy"),
        ("selector", "Healthy", "Failed", "Healthy"),
        ("selector", "Failed", "Healthy", "Healthy"),
        ("selector", "Failed", "Starting", "Starting"),
        ("selector", "Starting", "Failed", "Starting"),
        ("selector", "Failed", "Failed", "Failed"),
        ("sequence", "Healthy", "Healthy", "Healthy"),
        ("sequence", "Healthy", "Failed", "Failed"),
        ("sequence", "Failed", "Healthy", "Failed"),
        ("sequence", "Starting", "Failed", "Starting"),
        ("sequence", "Healthy", "Starting", "Starting"),
    ],
)
def test_a_composite_combines_the_states_of_its_children(kind, first, second, expected):
    samples = {"Healthy": [9.8], "Failed": [1.0], "Starting": []}
    world = World({kind: [gap("/a"), gap("/b")]}).arrive("/a", *samples[first]).arrive("/b", *samples[second])
    for _ in range(3):  # no state of an earlier tick may tell
        assert world.at(10).state == expected


def test_an_inverter_fails_while_the_topic_is_received():
    world = World({"inverter": gap("/e_stop", "1s")}, grace=2)
    assert world.at(1).state == "Starting"
    assert world.at(2).state == "Healthy"
    world.arrive("/e_stop", 3.0)
    assert world.at(3.5) == Verdict("Failed", "/e_stop is received, but the tree requires the opposite", "e_stop", None)
    assert world.at(4.0).state == "Healthy"


def test_a_verdict_names_the_first_failed_leaf_and_all_reasons():
    tree = {"parallel": [{"parallel": [gap("/scan"), gap("/odom")], "name": "sensors"}, gap("/cmd_vel")]}
    world = World(tree).arrive("/scan", 2.0).arrive("/odom", 2.3).arrive("/cmd_vel", 2.6)
    assert world.at(2.5) == Verdict("Failed", "no /scan for 500 ms", "sensors/scan", START + 2.0)
    verdict = world.at(2.9)
    assert (verdict.reason, verdict.leaf) == ("no /scan for 500 ms; no /odom for 500 ms", "sensors/scan")


def test_the_onset_of_a_selector_is_the_last_loss_of_its_children():
    world = World({"selector": [gap("/gps"), gap("/odom")]}).arrive("/gps", 1.0).arrive("/odom", 4.0)
    assert world.at(4.5).onset == START + 4.0


def test_the_onset_of_a_parallel_is_the_first_loss_of_its_children():
    world = World({"parallel": [gap("/odom"), gap("/gps")]}).arrive("/gps", 1.0).arrive("/odom", 4.0)
    assert world.at(4.5).onset == START + 1.0


def test_the_deadline_ignores_changes_that_do_not_matter():
    world = World({"selector": [gap("/a", "200ms"), gap("/b", "900ms")]}).arrive("/a", 1.0).arrive("/b", 1.0)
    assert world.deadline(1.1) == pytest.approx(1.9)


def test_a_healthy_tree_with_an_inverter_is_not_ticked():
    """Such as localization that is not judged while the laser is silent: each message would tick all nodes several times."""
    tree = {"parallel": [gap("/odom"), {"selector": [{"inverter": gap("/scan")}, gap("/pose", "900ms")]}]}
    world = World(tree).arrive("/odom", 1.0).arrive("/scan", 1.0).arrive("/pose", 1.0)
    world.at(1.1)
    ticked = []
    for node in world.tree.root.iterate():
        node.update = lambda name=node.name: ticked.append(name)
    assert world.at(1.2).state == "Healthy"
    assert world.deadline(1.2) == pytest.approx(1.5)
    assert not ticked


def test_a_topic_that_cannot_be_watched_is_left_out_of_its_composite():
    tree = {"parallel": [gap("/odom"), {"selector": [gap("/a"), gap("/b")]}, {"inverter": gap("/odd")}]}
    world = World(tree, grace=0).arrive("/odom", 1.0).arrive("/b", 1.0)
    assert world.at(1.2).state == "Healthy"
    world.tree.leave_out({"/a", "/odd"})
    assert [topic.name for topic in world.tree.judged] == ["/odom", "/b"]
    assert world.at(1.2).state == "Healthy"
    assert world.arrive("/odom", 2.0).at(2.1).reason == "no /b for 500 ms"
    world.tree.leave_out({"/b", "/a", "/odd"})
    assert world.at(2.1).state == "Healthy"
    assert world.deadline(2.1) == pytest.approx(2.5)


def test_a_tree_without_watched_topics_never_fails():
    world = World({"parallel": [gap("/a"), {"inverter": gap("/b")}]}, grace=1)
    world.tree.leave_out({"/a", "/b"})
    assert world.at(1000.0) == Verdict("Starting", "none of /a, /b can be watched", "", None)
    assert world.deadline(1000.0) is None
    world.tree.leave_out(frozenset())
    assert world.at(1000.0).state == "Failed"


def test_computing_the_deadline_leaves_no_trace():
    world = World(rate("/scan"), grace=30).arrive("/scan", *steady(10, 0, 1.95))
    assert world.at(1.9).state == "Starting"
    world.deadline(1.9)  # looks at 2.0, where the window is full and the band holds for a moment
    assert world.at(3.5).state == "Starting"


def test_computing_the_deadline_does_not_change_the_nodes():
    world = World({"selector": [gap("/a", "200ms"), {"inverter": gap("/b")}]}).arrive("/a", 1.0).arrive("/b", 1.0)
    world.at(1.1)
    before = [node.status for node in world.tree.root.iterate()]
    world.deadline(1.1)
    assert [node.status for node in world.tree.root.iterate()] == before


def test_a_recovered_leaf_is_shown_by_its_node():
    world = World({"selector": [gap("/a"), gap("/b")]}).arrive("/a", 1.0).arrive("/b", 2.0)
    assert world.at(2.1).state == "Healthy"
    world.arrive("/a", 2.2)
    world.at(2.3)
    assert [node.status.name for node in world.tree.root.iterate()] == ["SUCCESS"] * 3


def test_the_feedback_of_a_node_is_its_reason():
    world = World({"parallel": [gap("/scan"), gap("/odom")]}).arrive("/scan", 1.0)
    world.at(1.2)
    leaves = [node for node in world.tree.root.iterate() if not node.children]
    assert [leaf.feedback_message for leaf in leaves] == [
        "/scan is received",
        "waiting for the first /odom, for up to 30 s",
    ]


TOPICS = ["/a", "/b", "/c"]

LEAVES = st.one_of(
    st.builds(gap, st.sampled_from(TOPICS), st.sampled_from(["100ms", "250ms", "1s", "3s"])),
    st.builds(
        rate, st.sampled_from(TOPICS), st.sampled_from(["> 4 Hz", ">= 2 Hz", "< 9 Hz", "2 to 8 Hz"]), st.just("1s")
    ),
)
TREES = st.recursive(
    LEAVES,
    lambda nodes: st.one_of(
        st.builds(
            lambda kind, children: {kind: children},
            st.sampled_from(["parallel", "sequence", "selector"]),
            st.lists(nodes, min_size=1, max_size=3),
        ),
        st.builds(lambda child: {"inverter": child}, nodes),
    ),
    max_leaves=5,
)
ARRIVALS = st.dictionaries(
    st.sampled_from(TOPICS), st.lists(st.floats(0.0, 6.0), max_size=40).map(sorted), max_size=len(TOPICS)
)


def numbered(tree: dict[str, Any], count: list[int]) -> dict[str, Any]:
    """The tree with a name of its own for each leaf."""
    for kind in ("parallel", "sequence", "selector"):
        if kind in tree:
            return {kind: [numbered(child, count) for child in tree[kind]]}
    if "inverter" in tree:
        return {"inverter": numbered(tree["inverter"], count)}
    count[0] += 1
    return {**tree, "name": f"leaf{count[0]}"}


@settings(max_examples=400, deadline=None)
@given(
    tree=TREES,
    arrivals=ARRIVALS,
    grace=st.sampled_from([0.0, 0.7, 4.0, 30.0]),
    since=st.floats(0.0, 5.0),
    wait=st.floats(0.0, 2.0),
    between=st.floats(0.0, 1.0),
)
def test_the_verdict_becomes_worse_exactly_at_the_deadline(tree, arrivals, grace, since, wait, between):
    inverted = "inverter" in str(tree)  # then not before the deadline
    world = World(numbered(tree, [0]), grace=grace, since=since)
    for topic in world.records:
        world.arrive(topic, *arrivals.get(topic, []))
    observations = RecordedObservations(world.records)
    now = START + max([since, *(record.last - START for record in world.records.values() if record.last)]) + wait

    def badness(moment: float) -> int:
        return SEVERITY[world.tree.evaluate(observations, now=moment, since=world.since).state]

    present = badness(now)
    moment = world.tree.deadline(observations, now=now, since=world.since)
    if moment is None:
        later = now
        for step in (0.01, 0.5, 1.0, 5.0, 40.0):
            later += step
            # By time alone only: the memory that a rate has held may be fresh from the moment before.
            fresh = load(numbered(tree, [0]), grace=grace)
            fresh.evaluate(observations, now=now, since=world.since)
            assert SEVERITY[fresh.evaluate(observations, now=later, since=world.since).state] <= present
        return
    assert moment > now
    middle = now + between * (moment - now)
    fresh = load(numbered(tree, [0]), grace=grace)
    fresh.evaluate(observations, now=now, since=world.since)
    if middle < moment:
        assert SEVERITY[fresh.evaluate(observations, now=middle, since=world.since).state] <= present
    before = math.nextafter(moment, 0)
    fresh = load(numbered(tree, [0]), grace=grace)
    fresh.evaluate(observations, now=now, since=world.since)
    assume(before > now)
    assert SEVERITY[fresh.evaluate(observations, now=before, since=world.since).state] <= present
    fresh = load(numbered(tree, [0]), grace=grace)
    fresh.evaluate(observations, now=now, since=world.since)
    assert inverted or SEVERITY[fresh.evaluate(observations, now=moment, since=world.since).state] > present
