"""An object with deeply nested values ends no request, list or watch: it is read without them, like every other object."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import AsyncIterator

import pytest

from tests.support.nested_values import DEPTHS, PLACE, Answers, api_server, list_of, text
from tests.unit.controller.world import policy
from understudy.kube.client import POLICIES, Access, Client, Object, Part
from understudy.kube.watched_collection import Reflector


def deep(levels: int, version: int = 10) -> str:
    """A policy with values nested in its tree, and so in the record of its manager."""
    found = policy("Restart", name="deep", tree={"topic": PLACE})
    found["metadata"] |= {
        "resourceVersion": str(version),
        "managedFields": [{"fieldsV1": {"f:spec": PLACE}}],
        "annotations": {"note": 'braces in a text: "{{[[\\ are none'},
    }
    return text(found, levels)


def shallow(name: str) -> str:
    return text(policy("Restart", name=name), 0)


def names(items: list[Object]) -> list[str]:
    return [item["metadata"]["name"] for item in items]


@contextlib.asynccontextmanager
async def client(answers: Answers) -> AsyncIterator[Client]:
    async with api_server(answers) as url, Client(Access(url, ssl.create_default_context())) as found:
        yield found


@pytest.mark.parametrize("levels", DEPTHS)
def test_a_part_of_a_list_yields_every_object(levels: int) -> None:
    part = Part.of(list_of("FailurePolicy", [shallow("a"), deep(levels), shallow("b")]).encode())
    found = list(part.items())
    assert names(found) == ["a", "deep", "b"]
    assert found[1]["spec"]["strategies"] == [{"type": "Restart"}]
    assert found[1]["metadata"]["annotations"] == {"note": 'braces in a text: "{{[[\\ are none'}
    assert part.head["metadata"]["resourceVersion"] == "50"


@pytest.mark.parametrize("levels", DEPTHS)
async def test_requests_lists_and_watches_receive_every_object(levels: int) -> None:
    answers = Answers()
    answers.lists = {"failurepolicies": list_of("FailurePolicy", [deep(levels), shallow("a")]), "deep": deep(levels)}
    answers.events["failurepolicies"] = [
        f'{{"type":"MODIFIED","object":{item}}}' for item in (deep(levels), shallow("b"))
    ]
    async with client(answers) as found:
        assert names([await found.get(POLICIES, "fleet", "deep")]) == ["deep"]
        assert names((await found.list(POLICIES, "fleet"))["items"]) == ["deep", "a"]
        watched = [item async for _, item in found.watch(POLICIES, "fleet", version="50")]
    assert names(watched) == ["deep", "b"]


async def test_a_local_copy_follows_the_other_objects() -> None:
    answers = Answers()
    answers.lists["failurepolicies"] = list_of("FailurePolicy", [deep(1_500), shallow("a")])
    answers.events["failurepolicies"] = [
        f'{{"type":"MODIFIED","object":{item}}}' for item in (deep(9_000, version=51), shallow("b"))
    ]
    async with client(answers) as found:
        copy = Reflector(found, POLICIES, "fleet")
        task = asyncio.create_task(copy.run())
        async with asyncio.timeout(5):
            while "b" not in copy.items and not task.done():
                await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert set(copy.items) == {"deep", "a", "b"}
