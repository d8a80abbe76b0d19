"""The leaves age and diagnostics."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.content_messages import Array, Status, age, levels
from tests.unit.trees.messages import Battery, fields
from tests.unit.trees.world import START, World, states_in_both_forms, written
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.languages.short.health_loader import TreeError, load

# -- age --------------------------------------------------------------------------------------------------------------


def test_the_age_of_a_message_is_measured_at_its_receipt():
    world = World(age()).hear("/scan", 1.0, late=0.3)
    assert world.at(9.0).state == "Healthy", "how long ago it was received is for a gap"
    verdict = world.hear("/scan", 10.0, late=0.4123).at(10.0)
    assert verdict == Verdict("Failed", verdict.reason, "scan.age", START + 1.0)
    assert_golden("health_tree", verdict.reason, "300 ms", "/scan", "412 ms")
    assert world.hear("/scan", 11.0, late=-2.0).at(11.0).state == "Healthy"
    assert (
        world.hear("/scan", 12.0, late=None)
        .at(12.0)
        .reason.endswith("cannot be determined: it has no stamp, but at most 300 ms is required")
    )


def test_with_for_a_single_late_message_is_no_failure():
    world = World(age(**{"for": "1s"})).hear("/scan", 1.0, late=0.1)
    world.at(1.0)
    assert world.hear("/scan", 2.0, late=0.5).at(2.0).state == "Healthy"
    assert world.deadline(2.0) == 3
    assert world.hear("/scan", 2.5, late=0.1).at(3.5).state == "Healthy"
    world.hear("/scan", 4.0, late=2.5).at(4.0)
    assert_golden("health_tree", world.at(5.0).reason, "300 ms", "/scan", "1 s", "2.5 s")


def test_an_age_by_source_counts_from_the_sending_and_ignores_the_stamp():
    world = World(age(by="source")).hear("/scan", 1.0, late=9.0, way=0.3)
    assert world.at(9.0).state == "Healthy"
    verdict = world.hear("/scan", 10.0, late=0.0, way=0.4123).at(10.0)
    assert verdict == Verdict("Failed", verdict.reason, "scan.age", START + 1.0)
    assert_golden("health_tree", verdict.reason, "300 ms", "/scan", "412 ms")
    assert world.hear("/scan", 11.0, way=-2.0).at(11.0).state == "Healthy", "a clock that is ahead"
    assert_golden("health_tree", world.hear("/scan", 12.0, late=0.0).at(12.0).reason, "cannot be determined")


def test_an_age_by_source_needs_no_header():
    load({"age": {"topic": "/p", "type": "t/msg/Pack", "most": "1s", "by": "source"}}, fields=fields)


def test_the_age_leaf_is_the_same_in_all_languages():
    short = {"parallel": [age(by="source", **{"for": "1s"}), {**age(by="stamp"), "name": "stamped"}]}
    text = written(
        '<Age topic="/scan" most="300ms" for="1s" by="source"/><Age name="stamped" topic="/scan" most="300ms" by="stamp"/>'
    )

    def drive(world):
        for time, late, way in ((1, 0.1, 0.1), (2, 0.1, 0.5), (3.5, 0.1, 0.5), (4, 0.4, 0.2), (5, 0.2, 0.2)):
            world.hear("/scan", time, late=late, way=way)
            yield from (world.at(time), world.deadline(time))

    assert states_in_both_forms(text, short, drive) == ["Starting", "Healthy", "Healthy", "Failed", "Failed", "Healthy"]


@settings(max_examples=100, deadline=None)
@given(
    ways=st.lists(st.tuples(st.integers(0, 600), st.sampled_from([0.0, 0.2, 0.4, None])), max_size=12),
    hold_off=st.sampled_from([None, "700ms"]),
    now=st.integers(0, 600),
)
def test_the_deadline_of_an_age_by_source_is_the_first_worse_moment(ways, hold_off, now):
    """Times in hundredths of a second."""
    world = World(age(by="source", **({"for": hold_off} if hold_off else {})), grace=2.0)
    for time, way in sorted(ways, key=lambda one: one[0]):
        if time <= now:
            world.hear("/scan", time / 100, way=way).at(time / 100)
    present = SEVERITY[world.at(now / 100).state]
    deadline = world.deadline(now / 100)
    worse = next((now + step for step in range(1, 400) if SEVERITY[world.at((now + step) / 100).state] > present), None)
    assert (deadline is None) == (worse is None)
    assert deadline is None or math.isclose(worse / 100, deadline, abs_tol=0.011)


# -- diagnostics ------------------------------------------------------------------------------------------------------


def test_the_last_level_of_a_status_counts_regardless_of_other_statuses():
    world = World(levels(name="camera: driver"), grace=10)
    world.hear("/diagnostics", 1.0, Array(Status("lidar", 2, "dead")))
    assert_golden("health_tree", world.at(1.0).reason, "/diagnostics", "10 s")
    world.hear("/diagnostics", 2.0, Array(Status("lidar", 2), Status("camera: driver", 1)))
    assert world.at(2.0).state == "Healthy"
    world.hear("/diagnostics", 3.0, Array(Status("camera: driver", 2, "no\nframes")))
    world.hear("/diagnostics", 3.1, Array(Status("lidar", 0)))
    verdict = world.at(3.2)
    assert verdict == Verdict("Failed", verdict.reason, "diagnostics", START + 2.0)
    assert_golden("health_tree", verdict.reason, "WARN", "/diagnostics", "'camera: driver' is ERROR (no frames)")
    world.hear("/diagnostics", 4.0, Array(Status("camera: driver", 0)))
    assert world.at(4.0).state == "Healthy"


def test_the_worst_level_of_all_statuses_with_the_prefix_counts():
    world = World(levels(prefix="camera", **{"for": "1s"}))
    world.hear("/diagnostics", 1.0, Array(Status("camera a", 0), Status("camera b", 0))).at(1.0)
    world.hear("/diagnostics", 2.0, Array(Status("camera b", 3, "gone")))
    world.hear("/diagnostics", 2.1, Array(Status("camera a", 2, "hot"))).at(2.2)
    assert world.deadline(2.2) == 3
    assert world.at(3.0).reason.endswith(
        "status 'camera b' is STALE (gone), but at most WARN is required (violated for 1 s)"
    )
    world.hear("/diagnostics", 3.1, Array(Status("camera b", 0)))
    assert world.at(3.2).state == "Failed"
    world.hear("/diagnostics", 3.3, Array(Status("camera a", 0)))
    assert world.at(3.4).state == "Healthy"


def test_without_a_name_every_status_counts_and_the_next_instance_starts_without_levels():
    world = (
        World(levels(worst="OK"), grace=10)
        .hear("/diagnostics", 1.0, Array(Status("a", 0)))
        .hear("/diagnostics", 1.1, Array(Status("b", 1), Status("c", 200)))
    )
    assert world.at(1.2).state == "Starting"
    assert "status 'c' is level 200, and 1 more, but " in world.at(10).reason
    world.since = START + 20
    world.hear("/diagnostics", 21.0, Array(Status("a", 0)))
    assert world.at(21).state == "Healthy"


def test_diagnostics_of_understudy_itself_are_ignored():
    for more in ({}, {"prefix": "u"}, {"topic": "/diagnostics_agg"}):
        world = World(levels(**more), grace=10)
        topic = more.get("topic", "/diagnostics")
        world.hear(
            topic, 1.0, Array(Status("understudy: robot-1-drive", 2), Status("/Other/understudy: robot-1-drive", 2))
        )
        assert world.at(1.0).reason.startswith("waiting for the first status")
        world.hear(topic, 2.0, Array(Status("understudy: robot-1-drive", 2), Status("usb", 0)))
        assert world.at(2.0).state == "Healthy"
        world.hear(topic, 3.0, Array(Status("understudy: robot-1-drive", 3)))
        assert world.at(3.0).state == "Healthy"


@pytest.mark.parametrize("key", ["name", "prefix"])
@pytest.mark.parametrize("text", ["understudy:", "understudy: robot-1-drive"])
def test_diagnostics_of_understudy_itself_cannot_be_selected(key, text):
    with pytest.raises(
        TreeError, match=rf"\.{key}: found '{text}': Understudy's own status is no evidence; give a status of"
    ):
        load(levels(**{key: text}))


def test_memory_of_statuses_is_bounded_and_messages_of_another_type_are_reported():
    world = World(levels(prefix="n"))
    world.hear("/diagnostics", 0.1, Array(Status("n-first", 2))).at(0.1)
    world.hear("/diagnostics", 0.2, Array(*(Status(f"n{i}", 0) for i in range(511))))
    assert "'n-first' is ERROR" in world.at(0.2).reason
    world.hear("/diagnostics", 0.3, Array(Status("n511", 0)))
    assert world.at(0.3).state == "Healthy", "only the last 512 are remembered"
    assert_golden(
        "health_tree", world.hear("/diagnostics", 5.0, Battery()).at(5.0).reason, "diagnostic_msgs", "DiagnosticArray"
    )
