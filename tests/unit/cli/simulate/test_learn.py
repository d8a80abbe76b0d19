"""Leaves that are learnt from a recording hold in it, and do not in another one in which something is wrong."""

from __future__ import annotations

import itertools
import random
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.bag_recording import RecordedMessage, every, write
from tests.support.golden import assert_golden
from tests.unit.trees.world import World
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.learn import main
from understudy.cli.simulate.learned_bounds import FACTOR, MARGIN, extremes, measured, proposed
from understudy.cli.simulate.replay import replay
from understudy.trees.core.rate_window import Band
from understudy.trees.languages.short.health_loader import load

TWIST = "geometry_msgs/msg/Twist"


def jittery(topic: str, end: float, hertz: float) -> list[RecordedMessage]:
    chance = random.Random(7)
    return [RecordedMessage(n / hertz + chance.uniform(0, 0.4 / hertz), topic, TWIST) for n in range(int(end * hertz))]


def learn(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any], str]:
    status = main(list(arguments))
    captured = capsys.readouterr()
    return status, yaml.safe_load(captured.out), captured.err


def failures(bag: Path, tree: dict[str, Any]) -> list[str]:
    with Bag.open(str(bag)) as opened:
        return [one.reason for one in replay(load(tree), 0.0, opened).evaluation.detections]


def test_without_topics_the_commands_are_learned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    named = [*every("/arm/command", "std_msgs/msg/Float64MultiArray", 0, 5, 20), *every("/cmd_vel", TWIST, 0, 5, 20)]
    others = [
        *every("/level", "std_msgs/msg/Float64", 0, 5, 20),
        *every("/scan", "sensor_msgs/msg/LaserScan", 0, 5, 20),
    ]
    _, tree, _ = learn(capsys, "--bag", str(write(tmp_path / "all", sorted([*named, *others], key=lambda one: one.at))))
    assert [leaf["topic"]["name"] for leaf in tree["parallel"]] == ["/arm/command", "/cmd_vel"]
    assert main(["--bag", str(write(tmp_path / "none", sorted(others, key=lambda one: one.at)))]) == 2
    assert "no topic looks like commands to a robot; name topics with --topic: /level, /scan" in capsys.readouterr().err


def test_learnt_leaves_pass_their_recording_and_fail_slower_faster_or_silent_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = write(tmp_path / "good", [*jittery("/a", 40, 20), *every("/b", TWIST, 0, 40, 5)])
    status, tree, err = learn(capsys, "--bag", str(good), "--topic", "/a", "--topic", "/b")
    assert (status, err) == (0, "")
    assert [leaf["topic"]["name"] for leaf in tree["parallel"]] == ["/a", "/b"]
    steady = tree["parallel"][1]["topic"]
    assert (steady["type"], steady["gap"]) == (TWIST, "400ms")
    assert 3.7 < float(Band.parse(steady["rate"]).low or 0) <= 4
    assert 6 <= float(Band.parse(steady["rate"]).high or 0) < 6.5
    assert failures(good, tree) == []
    for name, messages, reason in (
        ("slow", jittery("/a", 40, 13), r"/a at [0-9.]+ Hz, below [0-9.]+ Hz over .*"),
        ("fast", jittery("/a", 40, 30), r"/a at [0-9.]+ Hz, above [0-9.]+ Hz over .*"),
        ("silent", [one for one in jittery("/a", 40, 20) if not 20 < one.at < 21], "no /a for [0-9]+ ms"),
    ):
        found = failures(write(tmp_path / name, messages), {"parallel": tree["parallel"][:1]})
        assert re.fullmatch(reason, found[0]), (name, found)


def test_bounds_that_the_recording_violates_are_reported_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = [*every("/a", TWIST, 0, 30, 40), *every("/a", TWIST, 32, 60, 40)]
    status, tree, err = learn(capsys, "--bag", str(write(tmp_path / "bag", messages)), "--topic", "/a")
    assert status == 1
    assert tree["parallel"][0]["topic"]["gap"] == "50ms", "one gap of thousands is no measure"
    assert_golden("simulate", err, "30.025 s", "/a", "50 ms")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--topic", "/aa"], "the bag has no topic '/aa', did you mean '/a'?"),
        (["--topic", "/few"], "there are 3 messages of /few; at least 20 are required"),
    ],
)
def test_input_without_anything_to_learn_ends_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    bag = write(tmp_path / "bag", [*every("/a", TWIST, 0, 30, 10), *every("/few", TWIST, 0, 3, 1)])
    assert main(["--bag", str(bag), *arguments]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out == ""


def test_numbers_out_of_range_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--bag", "bag", "--topic", "/a", "--factor", "0.5"])
    assert ended.value.code == 2
    assert "found '0.5'; give a number from 1 to 100" in capsys.readouterr().err


@settings(max_examples=50, deadline=None)
@given(gaps=st.lists(st.integers(1, 900), min_size=30, max_size=60), window=st.sampled_from([0.5, 2.0]))
def test_the_extremes_equal_the_rates_that_the_leaf_measures(gaps: list[int], window: float) -> None:
    times = [total / 1000 for total in itertools.accumulate(gaps)]
    slowest, fastest = extremes(times, window)
    moments = [at for at in sorted({*times, *(at + window for at in times)}) if times[0] + window <= at <= times[-1]]
    counts = [sum(now < at + window and at <= now for at in times) for now in moments]
    most = max(sum(now < at + window and at <= now for at in times) for now in times)
    if times[-1] - times[0] < window:
        assert (slowest, fastest) == (0.0, 0.0)
    else:
        assert (slowest, fastest) == (min(counts) / window, most / window)


@settings(max_examples=25, deadline=None)
@given(gaps=st.lists(st.integers(1, 300), min_size=100, max_size=200))
def test_a_proposed_rate_holds_for_the_whole_recording(gaps: list[int]) -> None:
    times = [total / 1000 for total in itertools.accumulate(gaps)]
    bounds = proposed(times, measured(times), FACTOR, MARGIN)
    if bounds.band is None:
        return
    world = World({"topic": {"name": "/a", "rate": str(bounds.band), "window": f"{bounds.window:g}s"}})
    for time, following in itertools.pairwise([*times, times[-1]]):
        world.hear("/a", time)
        assert world.at(time).state != "Failed"
        deadline = world.deadline(time)
        assert deadline is None or deadline >= min(following, times[-1]) - 1e-6
