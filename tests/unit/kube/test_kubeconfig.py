"""A kubeconfig is read by the official package, credential plugins included, and a plugin's token is renewed."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import yaml
from aiohttp import web
from aiohttp.test_utils import TestServer

from understudy.kube.client import NODES, ApiError, Client
from understudy.kube.kubeconfig import RENEW_EARLY, KubeconfigError, load_access

PLUGIN = """#!/bin/sh
echo "$KUBERNETES_EXEC_INFO" > {folder}/asked
n=$(($(cat {folder}/count 2>/dev/null || echo 0) + 1))
echo $n > {folder}/count
echo '{{"apiVersion": "client.authentication.k8s.io/v1", "kind": "ExecCredential",
  "status": {{"token": "token-'$n'"{expiry}}}}}'
"""


class Server:
    """Answers lists of nodes to who has the right token, and remembers the tokens that came."""

    def __init__(self) -> None:
        self.tokens: list[str] = []
        self.accepted = ""

    async def nodes(self, request: web.Request) -> web.Response:
        self.tokens.append(request.headers.get("Authorization", ""))
        if self.accepted and self.tokens[-1] != self.accepted:
            return web.json_response({"reason": "Unauthorized", "message": "no"}, status=401)
        return web.json_response({"items": [], "metadata": {"resourceVersion": "1"}})


def kubeconfig(folder: Path, server: str, user: dict[str, object]) -> str:
    file = folder / "config"
    found = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "here",
        "contexts": [{"name": "here", "context": {"cluster": "c", "user": "u"}}],
        "clusters": [{"name": "c", "cluster": {"server": server}}],
        "users": [{"name": "u", "user": user}],
    }
    file.write_text(yaml.safe_dump(found))
    return str(file)


def plugin(folder: Path, expiry: str = "") -> dict[str, object]:
    script = folder / "plugin.sh"
    script.write_text(PLUGIN.format(folder=folder, expiry=f', "expirationTimestamp": "{expiry}"' if expiry else ""))
    script.chmod(0o755)
    plugin_config = {
        "apiVersion": "client.authentication.k8s.io/v1",
        "command": str(script),
        "interactiveMode": "Never",
    }
    return {"exec": plugin_config}


async def served(handler: Server) -> TestServer:
    app = web.Application()
    app.router.add_get("/api/v1/nodes", handler.nodes)
    server = TestServer(app)
    await server.start_server()
    return server


async def test_a_credential_plugin_is_called_once_while_its_token_is_valid(tmp_path: Path) -> None:
    handler, later = Server(), (datetime.now(UTC) + timedelta(hours=1)).strftime("%Y-%m-%dT%H:%M:%SZ")
    server = await served(handler)
    path = kubeconfig(tmp_path, str(server.make_url("")), plugin(tmp_path, later))
    async with Client(await asyncio.to_thread(load_access, path)) as client:
        await client.list(NODES)
        await client.list(NODES)
    await server.close()
    assert handler.tokens == ["Bearer token-1", "Bearer token-1"]
    assert json.loads((tmp_path / "asked").read_text())["kind"] == "ExecCredential"


async def test_a_token_is_renewed_before_it_expires(tmp_path: Path) -> None:
    soon = datetime.now(UTC) + timedelta(seconds=RENEW_EARLY / 2)
    handler = Server()
    server = await served(handler)
    path = kubeconfig(tmp_path, str(server.make_url("")), plugin(tmp_path, soon.strftime("%Y-%m-%dT%H:%M:%SZ")))
    async with Client(await asyncio.to_thread(load_access, path)) as client:
        await client.list(NODES)
    await server.close()
    assert handler.tokens == ["Bearer token-2"]


async def test_the_plugin_is_called_again_after_a_401(tmp_path: Path) -> None:
    handler = Server()
    handler.accepted = "Bearer token-2"
    server = await served(handler)
    path = kubeconfig(tmp_path, str(server.make_url("")), plugin(tmp_path))
    async with Client(await asyncio.to_thread(load_access, path)) as client:
        with pytest.raises(ApiError, match="401"):
            await client.list(NODES)
        await client.list(NODES)
    await server.close()
    assert handler.tokens == ["Bearer token-1", "Bearer token-2"]


def test_a_static_token_needs_no_plugin(tmp_path: Path) -> None:
    access = load_access(kubeconfig(tmp_path, "https://127.0.0.1:6443", {"token": "fixed"}))
    assert (access.server, access.token, access.plugin) == ("https://127.0.0.1:6443", "fixed", None)


def test_a_failing_plugin_is_an_error_and_does_not_lead_to_anonymous_requests(tmp_path: Path) -> None:
    broken = {"apiVersion": "client.authentication.k8s.io/v1", "command": "false", "interactiveMode": "Never"}
    with pytest.raises(KubeconfigError, match="credential plugin"):
        load_access(kubeconfig(tmp_path, "https://127.0.0.1:6443", {"exec": broken}))


def test_a_missing_kubeconfig_is_reported_with_its_name(tmp_path: Path) -> None:
    with pytest.raises(KubeconfigError, match="missing"):
        load_access(str(tmp_path / "missing"))


def test_monitors_and_agents_do_not_import_the_official_package() -> None:
    shown = "import sys, understudy.monitor.process, understudy.agent.process; print('kubernetes' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
