"""Trees are checked in another process: no tree keeps the operator's loop busy, and no namespace keeps the others waiting."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from tests.unit.controller.world import NAMESPACE, custom
from tests.unit.kube.memory import MemoryClient
from tests.unit.trees.osc_texts import scenario
from understudy.controller.plan import Images
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.reconcile.tree_judge import TreeJudge
from understudy.kube.client import POLICIES, Object
from understudy.kube.events import Recorder
from understudy.process.tree_checker import TreeChecker
from understudy.trees.languages import tree_check
from understudy.trees.languages.tree_check import TreeText, Verdict
from understudy.trees.source import value_reader

COSTLY = scenario(*(f"n{index}: node('/{'a' * 60}{index}')" for index in range(650)))


class Noted:
    """A checker that notes what it is given, and waits until a tree may be checked."""

    def __init__(self) -> None:
        self.checked: list[str] = []
        self.running = False
        self.failing = 0

    async def check(self, tree: TreeText) -> Verdict:
        await asyncio.sleep(0)
        if self.failing:
            self.failing -= 1
            raise OSError("no more processes")
        self.checked.append(tree.path)
        return Verdict()

    async def close(self, *, kill: bool = False) -> None:
        self.running = False


def tree(path: str) -> TreeText:
    return TreeText("health", "yaml", "{}", path)


def key(namespace: str, name: str = "p") -> Key:
    return Key(POLICIES.plural, namespace, name)


async def until_judged(judge: TreeJudge, count: int) -> list[Key]:
    """Run a judge until so many objects were judged."""
    found: list[Key] = []
    ready = asyncio.Event()

    def judged(one: Key) -> None:
        found.append(one)
        if len(found) == count:
            ready.set()

    judge.judged = judged
    running = asyncio.create_task(judge.run())
    async with asyncio.timeout(120):
        await ready.wait()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return found


async def test_namespaces_take_turns() -> None:
    checker = Noted()
    judge = TreeJudge(checker)
    for index in range(3):
        judge.submit(tree(f"a{index}"), key("a", str(index)))
    judge.submit(tree("b"), key("b"))
    await until_judged(judge, 4)
    assert checker.checked == ["a0", "b", "a1", "a2"]


async def test_an_object_that_changes_while_it_waits_has_one_tree_checked() -> None:
    checker = Noted()
    judge = TreeJudge(checker)
    for index in range(100):
        judge.submit(tree(str(index)), key("a"))
    assert await until_judged(judge, 1) == [key("a")]
    assert checker.checked == ["99"]


async def test_a_tree_of_several_objects_is_checked_once() -> None:
    checker = Noted()
    judge = TreeJudge(checker)
    keys = [key("a", "p"), key("a", "q"), key("b", "p")]
    for one in keys:
        judge.submit(tree("same"), one)
    assert await until_judged(judge, 3) == keys
    assert checker.checked == ["same"]
    assert judge.find(tree("same")) == Verdict()


async def test_a_process_that_cannot_be_started_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("understudy.controller.reconcile.tree_judge.RETRY_SECONDS", 0.0)
    checker = Noted()
    checker.failing = 2
    judge = TreeJudge(checker)
    judge.submit(tree("a"), key("a"))
    await until_judged(judge, 1)
    assert checker.checked == ["a"]


async def test_an_idle_process_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("understudy.controller.reconcile.tree_judge.IDLE_SECONDS", 0.0)
    checker = Noted()
    checker.running = True
    running = asyncio.create_task(TreeJudge(checker).run())
    async with asyncio.timeout(30):
        while checker.running:
            await asyncio.sleep(0.01)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_verdicts_are_forgotten_by_their_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("understudy.controller.reconcile.tree_judge.REMEMBERED_MOST", 1000)
    judge = TreeJudge(Noted())
    for index in range(10):
        judge._remember(tree(str(index)), Verdict(tree="x" * 100))
    assert [index for index in range(10) if judge.find(tree(str(index))) is not None] == [8, 9]


# -- with the process ---------------------------------------------------------------------------------------------------


@pytest.fixture
async def checker() -> AsyncIterator[TreeChecker]:
    made = TreeChecker()
    yield made
    await made.close(kill=True)


@pytest.fixture
def no_check_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process check no tree, whoever asks."""

    def refused(*_: object, **__: object) -> None:
        raise AssertionError("a tree was checked on the operator's event loop")

    for name in ("load_health", "load_text", "compose"):
        monkeypatch.setattr(tree_check, name, refused)
    monkeypatch.setattr(value_reader.Reader, "is_node", refused)


def costly_policy(index: int) -> Object:
    tree: Object = {"osc": COSTLY.replace("healthy", f"healthy{index}")}
    situations = [{"name": f"s{other}", "when": tree} for other in range(2)]
    strategies = [{"type": "Restart"}]
    return custom(
        "FailurePolicy", f"p{index}", {"monitoring": tree, "strategies": strategies, "situations": situations}
    )


def reconciler(store: Store, trees: TreeJudge) -> Reconciler:
    client, expectations = MemoryClient(), Expectations()
    return Reconciler(
        client,
        store,
        Observer(client, store, expectations),
        Executor(client, store, expectations, may_write=lambda: True),
        Recorder(client, "understudy", "operator"),
        Images("monitor:1"),
        Rollouts(store),
        trees,
    )


async def test_costly_policies_are_judged_without_a_check_on_the_operators_loop(
    checker: TreeChecker, no_check_here: None
) -> None:
    store, judge = Store(), TreeJudge(checker)
    one = reconciler(store, judge)
    for index in range(4):
        store.put(POLICIES, costly_policy(index))
    statuses: dict[Key, Object] = {}
    waiting: asyncio.Queue[Key] = asyncio.Queue()
    judge.judged = waiting.put_nowait

    async def write(resource: object, item: Object, status: Object) -> None:
        statuses[key(NAMESPACE, item["metadata"]["name"])] = status

    one._write_status = write  # type: ignore[method-assign, assignment]
    for index in range(4):
        waiting.put_nowait(key(NAMESPACE, f"p{index}"))
    running = asyncio.create_task(judge.run())
    async with asyncio.timeout(300):
        while len(statuses) < 4:
            await one.reconcile(await waiting.get())
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    for status in statuses.values():
        _, accepted = status["conditions"]
        assert (accepted["status"], accepted["reason"]) == ("False", "TreeInvalid")
        assert "the tree has more than 512 nodes" in accepted["message"]
