"""Claims by version and by name, including claims whose answers are lost: a pod has one owner, and this owner knows it."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

import aiohttp
import pytest

from tests.support.answers import tabled
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.kube import claims, pod_tables
from understudy.kube.client import PODS, ApiError, Object

UNANSWERED: list[Exception] = [
    ApiError(504, "Timeout", "the server did not answer in time"),
    ApiError(429, "TooManyRequests", "try again"),
    aiohttp.ServerDisconnectedError(),
    TimeoutError(),
]


class Lossy(MemoryClient):
    """Loses answers to patches, or the patches themselves."""

    def __init__(self, *losses: tuple[Exception, bool]) -> None:
        super().__init__()
        self.losses = list(losses)
        self.during_request: Callable[[], None] = lambda: None

    async def patch(self, *args: object, **more: object) -> Object:
        if not self.losses:
            return await super().patch(*args, **more)  # type: ignore[arg-type]
        error, carried_out = self.losses.pop(0)
        if carried_out:
            await super().patch(*args, **more)  # type: ignore[arg-type]
        self.during_request()
        raise error


HELD = {names.HELD: "true", names.POOL: "spare"}
PLACE = (PODS.plural, "fleet", "spare-1")


async def free_pod(client: MemoryClient, annotations: Object | None = None) -> Object:
    metadata = {"name": "spare-1", "labels": {**HELD}, "annotations": annotations or {"of": "its own"}}
    return await client.create(PODS, "fleet", {"metadata": metadata, "spec": {}})


def by_name(pod: Object) -> Object:
    """Returns what a table contains about a pod."""
    [found] = pod_tables.pods(tabled({"metadata": {}, "items": [pod]}), namespace="fleet", labels=HELD)
    return found


def whole(pod: Object) -> Object:
    """Returns what a list contains about a pod."""
    return pod


async def claimed(client: MemoryClient, pod: Object, by: str = "w") -> Object:
    return await claims.claim(client, pod, workload=by, workload_uid=f"uid-{by}", claim=f"uid-{by}/1")


@pytest.mark.parametrize("outcome", [whole, by_name])
@pytest.mark.parametrize("carried_out", [True, False])
@pytest.mark.parametrize("error", UNANSWERED, ids=repr)
async def test_a_pod_is_claimed_once_although_the_answer_is_lost(
    error: Exception, carried_out: bool, outcome: Callable[[Object], Object]
) -> None:
    client = Lossy((error, carried_out))
    found = await claimed(client, outcome(await free_pod(client)))
    assert found["metadata"]["annotations"][names.CLAIM] == "uid-w/1"
    assert names.HELD not in found["metadata"]["labels"]
    writes = [name for method, name, _ in client.requests if method == "PATCH"]
    assert len(writes) == 1, "one that was carried out isn't made again"


@pytest.mark.parametrize("outcome", [whole, by_name])
async def test_a_pod_that_another_workload_claims_during_our_request_is_not_ours(
    outcome: Callable[[Object], Object],
) -> None:
    client = Lossy((TimeoutError(), False))
    pod = outcome(await free_pod(client))
    item = client.items[(PODS.plural, "fleet", "spare-1")]

    def another() -> None:
        item["metadata"] |= {"labels": {names.WORKLOAD: "v"}, "annotations": {names.CLAIM: "uid-v/1"}}

    client.during_request = another
    with pytest.raises(ApiError) as refused:
        await claimed(client, pod)
    assert refused.value.conflict


@pytest.mark.parametrize("outcome", [whole, by_name])
async def test_the_first_of_two_claims_gets_the_pod(outcome: Callable[[Object], Object]) -> None:
    client = MemoryClient()
    pod = outcome(await free_pod(client))
    first = await claimed(client, pod, by="v")
    with pytest.raises(ApiError) as refused:
        await claimed(client, pod, by="w")
    assert refused.value.conflict
    assert client.items[PLACE] == first


async def test_a_pod_known_by_name_is_claimed_with_one_write_although_it_has_changed() -> None:
    client = MemoryClient()
    pod = by_name(await free_pod(client))
    await client.patch(PODS, "fleet", "spare-1", {"status": {"phase": "Running"}})
    client.requests.clear()
    found = await claimed(client, pod)
    assert [method for method, _, _ in client.requests] == ["PATCH"]
    metadata = found["metadata"]
    assert metadata["labels"] == {names.POOL: "spare", names.WORKLOAD: "w"}
    assert metadata["annotations"].keys() == {"of", names.CLAIM, names.CLAIMED_AT}
    assert [(owner["kind"], owner["uid"], owner["controller"]) for owner in metadata["ownerReferences"]] == [
        ("RobotWorkload", "uid-w", True)
    ]


async def test_a_pod_known_by_name_is_claimed_if_it_has_no_annotations() -> None:
    client = MemoryClient()
    pod = by_name(await free_pod(client))
    del client.items[PLACE]["metadata"]["annotations"]
    found = await claimed(client, pod)
    assert found["metadata"]["annotations"][names.CLAIM] == "uid-w/1"


async def test_a_pod_of_another_pool_with_the_same_name_is_not_claimed() -> None:
    client = MemoryClient()
    pod = by_name(await free_pod(client))
    client.items[PLACE]["metadata"]["labels"][names.POOL] = "others"
    with pytest.raises(ApiError):
        await claimed(client, pod)
    assert names.WORKLOAD not in client.items[PLACE]["metadata"]["labels"]


async def test_a_claimed_pod_that_is_being_deleted_is_not_used() -> None:
    client = MemoryClient()
    pod = by_name(await free_pod(client))
    client.items[PLACE]["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:30Z"
    with pytest.raises(ApiError) as refused:
        await claimed(client, pod)
    assert refused.value.not_found


async def test_a_claim_on_a_dead_connection_is_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "TRY_WITHIN", 0.05)
    client = MemoryClient()
    pod = await free_pod(client)
    client.hang_once(monkeypatch)
    async with asyncio.timeout(5):
        assert (await claimed(client, pod))["metadata"]["labels"][names.WORKLOAD] == "w"


async def test_a_permanent_refusal_of_the_api_server_is_not_retried() -> None:
    client = Lossy((ApiError(403, "Forbidden", "not yours"), False))
    with pytest.raises(ApiError) as refused:
        await claimed(client, await free_pod(client))
    assert refused.value.status == 403
    assert [method for method, _, _ in client.requests] == ["POST"]


def test_the_parts_of_a_pool_have_about_equal_sizes() -> None:
    counted = Counter(claims.part(f"spare-{number}") for number in range(1600))
    assert len(counted) == claims.PARTS
    assert 60 < min(counted.values()) <= max(counted.values()) < 140
