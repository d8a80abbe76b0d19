"""A tree ends the process that checks it at most, and is refused then; the next tree is checked as if nothing had happened."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from tests.unit.process.hostile_checks import BUSY, CRASHING, GREEDY
from understudy.process import tree_checker
from understudy.process.tree_checker import TreeChecker
from understudy.trees.languages.tree_check import INVALID, TOO_COSTLY, TreeText, check

VALID = TreeText("procedure", "yaml", '{"set_lifecycle": {"node": "/amcl", "state": "inactive"}}', "spec.bringUp.yaml")
WRONG = TreeText("health", "osc", '"do it"', "spec.monitoring.osc")


@pytest.fixture
async def checker(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[TreeChecker]:
    monkeypatch.setattr(tree_checker, "_PROGRAM", "tests.unit.process.hostile_checks")
    made = TreeChecker()
    yield made
    await made.close(kill=True)


def hostile(path: str) -> TreeText:
    return TreeText("health", "yaml", "{}", path)


@pytest.mark.parametrize("tree", [VALID, WRONG], ids=["valid", "wrong"])
async def test_a_verdict_is_the_same_as_in_this_process(checker: TreeChecker, tree: TreeText) -> None:
    found, expected = await checker.check(tree), check(tree)
    assert (found.reason, found.message, found.tree) == (expected.reason, expected.message, expected.tree)
    assert bool(found.reason) == (tree is WRONG)


@pytest.mark.parametrize("path", [BUSY, GREEDY])
async def test_a_check_that_takes_too_much_is_ended_and_its_tree_is_refused(checker: TreeChecker, path: str) -> None:
    async with asyncio.timeout(120):
        verdict = await checker.check(hostile(path))
    assert verdict.reason == TOO_COSTLY
    assert verdict.message.startswith(f"{path}: its check takes more than ")
    assert not (await checker.check(VALID)).reason


async def test_a_tree_that_ends_the_process_is_refused(checker: TreeChecker) -> None:
    async with asyncio.timeout(120):
        verdict = await checker.check(hostile(CRASHING))
    assert (verdict.reason, verdict.message) == (INVALID, "crashing: the process that checks it ended with status 7")
    assert not (await checker.check(VALID)).reason


async def test_the_process_ends_with_its_input(checker: TreeChecker) -> None:
    assert not checker.running
    await checker.check(VALID)
    assert checker.running
    async with asyncio.timeout(60):
        await checker.close()
    assert not checker.running
