"""An object with deeply nested values is refused with its field and the limit; the operator follows all others."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest
from kopf._cogs.clients import api
from kopf._cogs.configs import diffbase, progress

from tests.support.nested_values import DEPTHS, PLACE, Answers, api_server, list_of, text
from tests.unit.controller import pools, world
from understudy.api.nesting import DEEPEST
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.runtime import kopf_handlers
from understudy.controller.runtime.resync import ListCycle
from understudy.controller.status import policy_status
from understudy.kube.client import POLICIES, POOLS, WORKLOADS, Access, Client, Object, Part, Resource
from understudy.kube.decoding import LONG

TREE = {"sequence": PLACE}


def with_safety(policy: Object) -> Object:
    policy["spec"]["safety"] = {"commands": [{"topic": "/cmd_vel", "message": TREE}]}
    return policy


DEEP: dict[str, tuple[Resource, Object]] = {
    "spec.monitoring.yaml": (POLICIES, world.policy("Restart", name="deep", tree=TREE)),
    "spec.safety.commands.0.message": (POLICIES, with_safety(world.policy("Restart", name="deep"))),
    "spec.initialization.yaml": (POOLS, world.hot("deep", initialization={"yaml": TREE})),
    "spec.template": (
        POOLS,
        world.spare("deep", template={"spec": {"containers": [{"name": "a", "env": PLACE}]}}),
    ),
    "spec.bringUp.yaml": (WORKLOADS, world.workload("deep", bringUp={"yaml": TREE})),
    "spec.monitor.resources": (WORKLOADS, world.workload("deep", monitor={"resources": TREE})),
}


def received(item: Object, levels: int) -> Object:
    """The object as the operator's client reads it."""
    kind = item["kind"]
    (found,) = Part.of(list_of(kind, [text(item, levels)]).encode()).items()
    return found


def accepted(resource: Resource, item: Object) -> Object:
    """The condition Accepted of an object."""
    if resource == WORKLOADS:
        status = world.World(item, world.policy("Restart")).status()
    elif resource == POLICIES:
        status = policy_status.status(item, pools={}, config_maps={}, users=[])
    else:
        status = pools.status(pools.observe(item))
    found: Object = next(one for one in status["conditions"] if one["type"] == "Accepted")
    return found


@pytest.mark.parametrize("field", DEEP)
@pytest.mark.parametrize("levels", DEPTHS)
def test_the_condition_names_the_field_and_the_limit(field: str, levels: int) -> None:
    resource, item = DEEP[field]
    store = Store()
    store.put(resource, received(item, levels))
    stored = store.get(resource, world.NAMESPACE, "deep")
    assert stored is not None
    found = accepted(resource, stored)
    assert (found["status"], found["reason"]) == ("False", "SpecInvalid")
    assert found["message"].startswith(f"{field}: ")
    assert f"{DEEPEST} levels" in found["message"]


class Server(Client):
    """Lists policies, and nothing else."""

    def __init__(self, *policies: str) -> None:
        self.policies = policies

    async def parts(self, resource: Resource, *_: Any, **__: Any) -> AsyncIterator[Part]:
        yield Part.of(list_of("FailurePolicy", self.policies if resource == POLICIES else ()).encode())


@pytest.mark.parametrize("levels", DEPTHS)
async def test_a_list_stores_every_object(levels: int) -> None:
    store = Store()
    deep = text(DEEP["spec.monitoring.yaml"][1], levels)
    changes = await ListCycle(Server(deep, text(world.policy("Restart"), 0)), store, ()).resync()
    assert sorted(change.new["metadata"]["name"] for change in changes if change.new) == ["deep", "policy"]


async def test_an_error_about_one_object_does_not_end_a_list(caplog: pytest.LogCaptureFixture) -> None:
    def noticed(change: ObservedChange) -> None:
        if change.new is not None and change.new["metadata"]["name"] == "surprising":
            raise KeyError("spec")

    store = Store()
    store.noticed = noticed
    listed = [text(world.policy("Restart", name=name), 0) for name in ("surprising", "policy")]
    changes = await ListCycle(Server(*listed), store, ()).resync()
    assert [change.new["metadata"]["name"] for change in changes if change.new] == ["policy"]
    assert "surprising" in caplog.text


@pytest.mark.parametrize("levels", DEPTHS)
async def test_the_watches_by_kopf_report_every_object(levels: int) -> None:
    deep, other = text(DEEP["spec.monitoring.yaml"][1], levels), text(world.policy("Restart"), 0)
    later = text(world.policy("Restart", name="later", tree=TREE), levels)
    last = text(world.policy("Restart", name="last"), 0)
    assert set(await watched([deep, other], [later, last])) == {"deep", "policy", "later", "last"}


async def test_the_watches_by_kopf_copy_no_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of 250,000 values takes 0.3 s, in which the event loop does nothing else."""
    monkeypatch.setattr(progress, "copy", SimpleNamespace(deepcopy=only_empty))
    monkeypatch.setattr(diffbase, "copy", SimpleNamespace(deepcopy=only_empty))
    listed, later = (text(world.policy("Restart", name=name), 0) for name in ("listed", "later"))
    assert set(await watched([listed], [later])) == {"listed", "later"}


async def test_kopf_decodes_no_long_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """It collected garbage meanwhile, and the event loop did nothing else for 0.1 s."""
    decoded = []

    def loads(line: str) -> Any:
        decoded.append(len(line))
        return json.loads(line)

    monkeypatch.setattr(api, "json", SimpleNamespace(loads=loads))
    long = world.policy("Restart", name="long", tree={"sequence": [[number] for number in range(50_000)]})
    seen = await watched([], [text(long, 0), text(world.policy("Restart", name="last"), 0)])
    assert seen == {"long": long, "last": world.policy("Restart", name="last")}
    assert decoded
    assert max(decoded) < LONG


def line(name: str, version: int, *, kind: str = "MODIFIED", values: int = 50_000) -> str:
    item = world.policy("Restart", name=name, tree={"sequence": [version] * values})
    return json.dumps({"type": kind, "object": item})


async def test_of_several_versions_of_a_long_object_the_newest_is_reported_once() -> None:
    found = kopf_handlers.LongObjects()
    older, newer = [json.loads(await found.shortened(line("long", version)))["object"] for version in (1, 2)]
    reported = found.whole(older)
    assert reported is not None
    assert reported["spec"]["monitoring"]["yaml"]["sequence"][0] == 2
    assert found.whole(newer) is None


async def test_a_long_object_that_became_short_is_reported_as_it_is() -> None:
    found = kopf_handlers.LongObjects()
    await found.shortened(line("long", 1))
    short = json.loads(await found.shortened(line("long", 2, values=1)))["object"]
    assert found.whole(short) == short


def only_empty(value: Any) -> Any:
    assert not value, "an object is copied"
    return {}


async def watched(listed: list[str], events: list[str]) -> dict[str, Object]:
    """The policies by name that kopf reports within 5 s, if the API server lists some and then sends events of others."""
    kopf_handlers.quiet()
    answers, seen, over = Answers(), dict[str, Object](), asyncio.Event()
    answers.lists[POLICIES.plural] = list_of("FailurePolicy", listed)
    answers.events[POLICIES.plural] = [f'{{"type":"ADDED","object":{item}}}' for item in events]

    def see(resource: Resource, item: Object, gone: bool) -> None:
        seen[item["metadata"]["name"]] = item
        if len(seen) == len(listed) + len(events):
            over.set()

    async with api_server(answers) as url:
        access = Access(server=url, context=ssl.create_default_context())
        watching = asyncio.create_task(kopf_handlers.watch(see, access, []))
        waiting = asyncio.create_task(over.wait())
        await asyncio.wait({watching, waiting}, timeout=5, return_when=asyncio.FIRST_COMPLETED)
        for task in (watching, waiting):
            task.cancel()
        await asyncio.gather(watching, waiting, return_exceptions=True)
    return seen
