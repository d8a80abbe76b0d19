"""The addresses of the API server, as pods reach it."""

from __future__ import annotations

import pytest

from understudy.kube import apiserver_addresses
from understudy.kube.apiserver_addresses import ApiServerAddresses
from understudy.kube.client import ApiError, Object, Resource

POD = {"KUBERNETES_SERVICE_HOST": "10.96.0.1", "KUBERNETES_SERVICE_PORT": "443"}
SLICE: Object = {
    "endpoints": [{"addresses": ["192.168.0.3"]}, {"addresses": ["192.168.0.2"]}],
    "ports": [{"name": "https", "port": 6443, "protocol": "TCP"}],
}
BEHIND = (("192.168.0.2", 6443), ("192.168.0.3", 6443))


class Slices:
    """An API server with one EndpointSlice."""

    def __init__(self) -> None:
        self.answer: Object | Exception | None = SLICE
        self.reads = 0

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        assert (resource.plural, namespace, name) == ("endpointslices", "default", "kubernetes")
        self.reads += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


async def test_the_service_and_all_servers_behind_it_are_named() -> None:
    assert await ApiServerAddresses(Slices(), POD).read() == (("10.96.0.1", 443), *BEHIND)
    assert await ApiServerAddresses(Slices(), {}).read() == BEHIND


async def test_they_are_read_once_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    slices = Slices()
    addresses = ApiServerAddresses(slices, POD)
    for _ in range(3):
        await addresses.read()
    assert slices.reads == 1
    monkeypatch.setattr(apiserver_addresses, "REREAD", -1.0)
    for _ in range(2):
        addresses._due = 0.0
        await addresses.read()
    assert slices.reads == 3


@pytest.mark.parametrize("error", [ApiError(403, "Forbidden", "no"), OSError("away")], ids=["refused", "away"])
async def test_the_last_ones_are_kept_while_they_cannot_be_read(error: Exception) -> None:
    slices = Slices()
    addresses = ApiServerAddresses(slices, POD)
    await addresses.read()
    slices.answer, addresses._due = error, 0.0
    assert await addresses.read() == (("10.96.0.1", 443), *BEHIND)
