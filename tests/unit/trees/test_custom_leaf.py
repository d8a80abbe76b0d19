"""Leaves of one's own: what a class must be like, what it is given, and that a mistake in it costs one leaf and nothing else."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.trees.messages import Battery
from tests.unit.trees.world import START, World
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.snapshots import snapshot
from understudy.trees.languages.short import health_loader
from understudy.trees.languages.short.health_loader import load
from understudy.trees.leaves.custom_leaf import kind_of
from understudy.trees.source.problems import TreeError


class Falling:
    """Has nothing against a battery that falls by less than ``most`` from one message to the next."""

    def __init__(self, most: float = 0.1) -> None:
        if most <= 0:
            raise ValueError(f"found most: {most:g}; give more than 0")
        self.most, self.before = most, 1.0

    def judge(self, message: Any) -> str | None:
        fell, self.before = self.before - message.percentage, message.percentage
        return f"it fell by {fell:.2g}" if fell > self.most else None


Install = Callable[[object], None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    """Has a class be the leaf acme_leaf."""

    def installed(judge: object) -> None:
        leaves = {**health_loader.LEAVES, "acme_leaf": kind_of("acme_leaf", judge)}
        monkeypatch.setattr(health_loader, "LEAVES", leaves)
        monkeypatch.setattr(health_loader, "KINDS", (*health_loader.KINDS, "acme_leaf"))

    return installed


def leaf(**more: Any) -> dict[str, Any]:
    return {"acme_leaf": {"topic": "/battery", "type": "t/msg/Battery", **more}}


def refusal(**more: Any) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load(leaf(**more))
    return [str(problem).removeprefix("spec.monitoring.yaml.acme_leaf") for problem in caught.value.problems]


# -- what it says -----------------------------------------------------------------------------------------------------


def test_a_reason_returned_by_the_judge_is_a_failure_at_once(install: Install) -> None:
    install(Falling)
    world = World(leaf()).battery(1.0, 0.95)
    assert world.at(1.0).state == "Healthy"
    verdict = world.battery(2.0, 0.5).at(2.0)
    assert verdict == Verdict("Failed", verdict.reason, "battery.acme_leaf", START + 1.0)
    assert_golden("health_tree", verdict.reason, "acme_leaf", "/battery", "0.45")
    assert world.battery(3.0, 0.45).at(3.0).state == "Healthy"
    (topic,) = world.tree.topics
    assert (topic.prompt, topic.whole) == (True, True)


def test_with_for_the_failure_has_a_deadline(install: Install) -> None:
    install(Falling)
    world = World(leaf(**{"for": "500ms"})).battery(1.0, 0.95)
    world.at(1.0)
    world.battery(2.0, 0.5).at(2.0)
    assert world.deadline(2.0) == 2.5
    assert world.states([2.49, 2.5]) == ["Healthy", "Failed"]


def test_each_instance_has_its_own_judge(install: Install) -> None:
    install(Falling)
    world = World(leaf()).battery(1.0, 0.95).battery(2.0, 0.9)
    assert world.states([1.0, 2.0]) == ["Healthy", "Healthy"]
    world.since = START + 3.0
    assert_golden("health_tree", world.battery(4.0, 0.85).at(4.0).reason, "acme_leaf", "/battery", "0.15")


def test_a_snapshot_shows_the_leaf_with_its_name(install: Install) -> None:
    install(Falling)
    world = World(leaf()).battery(1.0, 0.5)
    world.at(1.0)
    shown = snapshot(world.tree, world.observed(), START + 1.0)
    assert shown is not None
    assert (shown["name"], shown["kind"], shown["state"]) == ("battery.acme_leaf", "acme_leaf", "Starting")


# -- mistakes in it ---------------------------------------------------------------------------------------------------


class Broken:
    def judge(self, message: Any) -> Any:
        if message.percentage > 0.5:
            raise KeyError("cells")
        return True if message.percentage > 0.4 else None


def test_a_leaf_that_raises_does_not_fail_and_reports_itself_as_blind(
    install: Install, caplog: pytest.LogCaptureFixture
) -> None:
    install(Broken)
    world = World({"parallel": [leaf(), {"topic": {"name": "/scan", "gap": "1s"}}]}).hear("/scan", 1.0)
    with caplog.at_level(logging.ERROR):
        assert world.battery(1.0, 0.9).at(1.0).state == "Healthy"
        assert world.battery(1.5, 0.8).at(1.5).state == "Healthy"
    assert_golden("health_tree", world.tree.blind, "acme_leaf", "/battery", "KeyError", "'cells'")
    assert [record.message for record in caplog.records] == world.tree.blind, "once, however many messages there are"
    assert world.at(2.0).leaf == "scan", "the rest of the tree goes on protecting"


def test_a_leaf_that_does_not_return_text_is_blind_until_it_judges_again(install: Install) -> None:
    install(Broken)
    world = World(leaf()).battery(1.0, 0.45)
    assert world.at(1.0).state == "Healthy"
    assert_golden("health_tree", world.tree.blind, "acme_leaf", "/battery", "TypeError")
    assert world.battery(2.0, 0.3).at(2.0).state == "Healthy"
    assert world.tree.blind == []


def test_an_unreadable_message_is_a_failure(install: Install) -> None:
    install(Falling)
    world = World(leaf()).battery(1.0, 0.95)
    world.at(1.0)
    assert world.hear("/battery", 2.0, "it is no Battery").at(2.0).state == "Failed"
    assert world.tree.blind == []


def test_the_reason_is_cut_to_the_length_that_a_condition_allows(install: Install) -> None:
    class Talkative:
        def judge(self, message: Battery) -> str:
            return "x" * 100_000

    install(Talkative)
    assert len(World(leaf(), grace=0.0).battery(1.0, 0.95).at(1.0).reason) < 300


# -- what it is given -------------------------------------------------------------------------------------------------


def test_keys_are_read_by_their_types_in_all_languages(install: Install) -> None:
    made = []

    class Asking:
        def __init__(
            self, text: str, whole: int, number: float, truth: bool, length: timedelta, more: str = ""
        ) -> None:
            made.append((text, whole, number, truth, length, more))

        def judge(self, message: Battery) -> None: ...

    install(Asking)
    load(leaf(text="7", whole=7, number=7, truth=True, length="500ms"))
    load(leaf(text="7", whole="7", number="7", truth="true", length="500ms", more="m"))
    assert made == [("7", 7, 7.0, True, timedelta(milliseconds=500), more) for more in ("", "m")]
    assert_golden(
        "tree_problems",
        refusal(text=7, whole=7.5, number="nan", truth="yes", length=500),
        ".text: found 7",
        ".whole: found 7.5",
        ".number: found 'nan'",
        ".truth: found 'yes'",
        ".length: found 500",
    )
    assert_golden(
        "tree_problems",
        refusal(text="7", whole=7, number=7, truth=[], lenght="1s"),
        ".lenght: ",
        "'length'",
        ".truth: found a list",
        ".length: missing",
        "acme_leaf",
    )


def test_a_value_that_the_judge_refuses_is_reported_in_its_own_words(install: Install) -> None:
    install(Falling)
    assert refusal(most=-1) == [": found most: -1; give more than 0"]


def test_a_judge_that_cannot_be_created_refuses_only_the_tree(install: Install) -> None:
    class Careless:
        def __init__(self) -> None:
            self.table = {}["calibration"]

        def judge(self, message: Battery) -> None: ...

    install(Careless)
    assert_golden("tree_problems", refusal(), "acme_leaf", "KeyError", "'calibration'")


def test_the_topic_is_required_and_the_example_lists_the_required_keys(install: Install) -> None:
    class Field:
        def __init__(self, field: str, most: float = 1.0) -> None: ...

        def judge(self, message: Battery) -> None: ...

    install(Field)
    with pytest.raises(TreeError, match=r"'acme_leaf' must be a mapping such as \{topic: /scan, field: ...\}"):
        load({"acme_leaf": []})
    with pytest.raises(TreeError, match=r"topic: missing; give the topic's fully qualified name, such as /scan"):
        load({"acme_leaf": {"field": "ranges"}})


# -- what it must be --------------------------------------------------------------------------------------------------


def judging(init: Callable[..., None]) -> type:
    return type("Made", (), {"__init__": init, "judge": lambda self, message: None})


def untyped(self: object, field) -> None: ...  # type: ignore[no-untyped-def]


def listed(self: object, fields: list[str]) -> None: ...


def unnamed(self: object, *fields: str) -> None: ...


def topical(self: object, topic: str) -> None: ...


def unknown(self: object, field: Feild) -> None: ...  # type: ignore[name-defined]  # noqa: F821


def odd(self: object, field: [str]) -> None: ...  # type: ignore[valid-type]


@pytest.mark.parametrize(
    ("judge", "why"),
    [
        (Falling(), "it must be a class with a method judge"),
        (object, "it must be a class with a method judge"),
        (7, "it must be a class with a method judge"),
        (judging(untyped), "its parameter field must have one of these as its type: str, int, float, bool, timedelta"),
        (judging(listed), "its parameter fields must have one of these"),
        (judging(unnamed), "cannot be given by name"),
        (judging(topical), "its parameter topic has the name of a key that every leaf has"),
        (judging(unknown), "the parameters of Made.. cannot be determined, NameError: name 'Feild' is not defined"),
        (judging(odd), "its parameter field must have one of these as its type"),
    ],
    ids=["object", "no-judge", "number", "untyped", "list", "args", "topic", "undefined", "odd"],
)
def test_an_object_that_is_not_a_judge_is_refused(judge: object, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        kind_of("acme_leaf", judge)
