"""An API server that does not know its client: it has just started, or the token is out of date. Over real HTTP."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from aiohttp import web

from tests.support.http_server import serving
from understudy.kube import api_contact, claims
from understudy.kube.client import POD_METRICS, PODS, Access, ApiError, Client


class Server:
    """Knows clients by one token, and knows of nothing that they may do before it has loaded the roles."""

    def __init__(self) -> None:
        self.accepted = "token-1"
        self.has_roles = True
        self.address = ""
        self.statuses: list[int] = []

    async def pod(self, request: web.Request) -> web.Response:
        if request.headers.get("Authorization") != f"Bearer {self.accepted}":
            return self._refused(401, "Unauthorized")
        if not self.has_roles:
            return self._refused(403, "Forbidden")
        self.statuses.append(200)
        return web.json_response({"metadata": {"name": "w-1"}})

    async def metrics(self, request: web.Request) -> web.Response:
        return self._refused(401, "Unauthorized")

    def _refused(self, status: int, reason: str) -> web.Response:
        self.statuses.append(status)
        return web.json_response({"reason": reason, "message": reason}, status=status)


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    found = Server()
    app = web.Application()
    app.router.add_get("/api/v1/namespaces/fleet/pods/w-1", found.pod)
    app.router.add_get("/apis/metrics.k8s.io/v1beta1/namespaces/fleet/pods", found.metrics)
    async with serving(app) as found.address:
        yield found


@pytest.fixture
async def client(server: Server, token: Path) -> AsyncIterator[Client]:
    async with Client(Access(server.address, ssl.create_default_context(), token_file=token)) as found:
        yield found


@pytest.fixture
def token(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.write_text("token-1")
    return file


async def test_a_server_that_knows_no_client_is_asked_again_until_it_does(server: Server, client: Client) -> None:
    server.accepted = "nobody's"
    asking = asyncio.create_task(claims.answered(lambda: client.get(PODS, "fleet", "w-1")))
    while len(server.statuses) < 3:
        await asyncio.sleep(0.01)
    assert client.contact.unanswered_since is not None, "no strategy is charged for this time"
    server.accepted = "token-1"
    assert (await asking)["metadata"]["name"] == "w-1"
    assert client.contact.unanswered_since is None


async def test_a_token_that_is_out_of_date_is_read_again_at_once(server: Server, client: Client, token: Path) -> None:
    await client.get(PODS, "fleet", "w-1")
    server.accepted = "token-2"
    await asyncio.to_thread(token.write_text, "token-2")
    with pytest.raises(ApiError):
        await client.get(PODS, "fleet", "w-1")
    await client.get(PODS, "fleet", "w-1")
    assert server.statuses == [200, 401, 200]


async def test_a_token_that_stays_wrong_is_named_in_the_error(server: Server, client: Client) -> None:
    server.accepted = "nobody's"
    with pytest.raises(ApiError, match=r"401 Unauthorized: .*token"):
        await client.get(PODS, "fleet", "w-1")


async def test_a_missing_role_counts_as_a_refusal_only_some_time_after_the_first_answer(
    server: Server, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A process that starts does not know whether the API server has only just started too.
    monkeypatch.setattr(api_contact, "JUST_BACK", 0.3)
    server.has_roles = False
    with pytest.raises(ApiError, match="403 Forbidden"):
        await claims.answered(lambda: client.get(PODS, "fleet", "w-1"))
    assert len(server.statuses) > 1
    assert client.contact.unanswered_since is None, "it answers"


async def test_an_aggregated_server_that_knows_no_client_is_no_outage_of_the_api_server(client: Client) -> None:
    with pytest.raises(ApiError, match="401"):
        await client.list(POD_METRICS, "fleet")
    assert client.contact.unanswered_since is None


async def test_an_outage_is_not_over_because_the_metrics_server_was_asked(server: Server, client: Client) -> None:
    """kube-apiserver itself answers 401 there too: it authenticates before it forwards."""
    server.accepted = "nobody's"
    with pytest.raises(ApiError, match="401"):
        await client.get(PODS, "fleet", "w-1")
    since = client.contact.unanswered_since
    assert since is not None
    with pytest.raises(ApiError, match="401"):
        await client.list(POD_METRICS, "fleet")
    assert client.contact.unanswered_since == since
