"""The API server by a socket of this machine's, as ``kubectl proxy`` offers it."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.common.errors import CommandError


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self._answer(404 if "missing" in self.path else 200, {"message": "pods is not found", "path": self.path})

    def do_PATCH(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self._answer(200, {"kind": self.headers["Content-Type"], "given": json.loads(body)})

    def address_string(self) -> str:
        return "here"

    def log_message(self, *_: object) -> None:
        pass

    def _answer(self, status: int, body: object) -> None:
        text = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)


@pytest.fixture
def api(tmp_path: Path) -> Iterator[Api]:
    path = str(tmp_path / "api")
    with socketserver.UnixStreamServer(path, Handler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        yield Api(path)
        server.shutdown()


def test_an_answer_contains_the_server_time_and_local_times(api: Api) -> None:
    answer = api.request("GET", "/version")
    assert answer.body["path"] == "/version"
    assert answer.date.endswith(" GMT")
    assert answer.asked <= answer.answered


def test_a_patch_has_its_content_type(api: Api) -> None:
    answer = api.request("PATCH", "/pods/one", {"spec": {}}, kind="application/merge-patch+json")
    assert answer.body == {"kind": "application/merge-patch+json", "given": {"spec": {}}}


def test_a_refusal_is_reported_with_the_message_of_the_server(api: Api) -> None:
    with pytest.raises(Refused, match="pods is not found") as refused:
        api.get("/pods/missing")
    assert refused.value.status == 404


def test_a_missing_proxy_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="the API server does not answer"):
        Api(str(tmp_path / "none")).get("/version")
