"""Asking a Prometheus over HTTP: what is sent, and what is said where it can't tell. What a real one answers, tests/e2e asks."""

from __future__ import annotations

import json
import threading
import urllib.parse
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from understudy.cli.common.errors import CommandError
from understudy.cli.report.prometheus.prometheus_client import Prometheus, Series

ANSWER = {"status": "success", "data": {"result": [{"metric": {"a": "b"}, "value": [12.5, "3"]}]}}


class Server:
    """Answers everything alike, and remembers what it was asked."""

    def __init__(self) -> None:
        self.status, self.text, self.headers = 200, json.dumps(ANSWER), dict[str, str]()
        self.asked: list[tuple[str, str | None]] = []
        """Paths with queries, each with who asked."""
        self._serving = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.url = f"http://127.0.0.1:{self._serving.server_port}"
        self._thread = threading.Thread(target=self._serving.serve_forever, args=(0.02,))
        self._thread.start()

    def close(self) -> None:
        self._serving.shutdown()
        self._thread.join()
        self._serving.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.asked.append((self.path, self.headers.get("Authorization")))
                self.send_response(server.status)
                for name, value in server.headers.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(server.text.encode())

            def log_message(self, format: str, *args: Any) -> None:
                """Nothing of it belongs into a test's output."""

        return Handler


def serving() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


server = pytest.fixture(serving, name="server")
other = pytest.fixture(serving, name="other")


def test_an_expression_at_a_moment_and_over_a_period(server: Server) -> None:
    prometheus = Prometheus(f"{server.url}/behind/")
    assert prometheus.query('up{a="b"}', 12.5) == [Series({"a": "b"}, [(12.5, 3.0)])]
    server.text = json.dumps({"data": {"result": [{"metric": {}, "values": [[1, "3"], [2, "+Inf"]]}]}})
    (series,) = prometheus.range("up", 1.0, 2.0, 0.5)
    assert (list(series.points), series.value) == ([(1.0, 3.0), (2.0, float("inf"))], float("inf"))
    first, second = (urllib.parse.urlsplit(path) for path, _ in server.asked)
    assert (first.path, dict(urllib.parse.parse_qsl(first.query))) == (
        "/behind/api/v1/query", {"query": 'up{a="b"}', "time": "12.500"},
    )  # fmt: skip
    assert (second.path, dict(urllib.parse.parse_qsl(second.query))) == (
        "/behind/api/v1/query_range", {"query": "up", "start": "1.000", "end": "2.000", "step": "0.500"},
    )  # fmt: skip


def test_a_token_is_for_the_one_that_was_named_alone(server: Server, other: Server, tmp_path: Path) -> None:
    (tmp_path / "token").write_text("secret\n")
    server.status, server.headers = 302, {"Location": f"{other.url}/api/v1/query"}
    Prometheus(server.url, token_file=str(tmp_path / "token")).query("up", 0.0)
    assert [who for _, who in server.asked] == ["Bearer secret"]
    assert [who for _, who in other.asked] == [None]


@pytest.mark.parametrize(
    ("status", "text", "words"),
    [
        (401, "", "answers 401: it requires a token; give one with --prometheus-token-file FILE"),
        (404, "<html>", "is not a Prometheus (404): give the address before /api/v1"),
        (200, "<html>", "is not a Prometheus: give the address before /api/v1"),
        (200, "[]", "is not a Prometheus"),
        (200, '{"data": {"result": [{"metric": {}}]}}', "is not a Prometheus"),
        (422, '{"errorType": "execution", "error": "too many samples"}', "reports an error: too many samples; name robots, or"),
        (503, '{"errorType": "timeout", "error": "query timed out"}', "reports an error: query timed out; name robots, or"),
        (400, '{"errorType": "bad_data", "error": "parse error"}', "reports an error: parse error"),
    ],
)  # fmt: skip
def test_what_it_can_not_tell(server: Server, status: int, text: str, words: str) -> None:
    server.status, server.text = status, text
    with pytest.raises(CommandError) as raised:
        Prometheus(server.url).query("up", 0.0)
    assert server.url in str(raised.value)
    assert words in str(raised.value)


def test_a_missing_answer_is_reported(server: Server) -> None:
    url = server.url.replace("127.0.0.1", "127.0.0.2")
    with pytest.raises(CommandError) as raised:
        Prometheus(url).query("up", 0.0)
    assert str(raised.value).startswith(f"Prometheus at {url} cannot be reached: Connection refused; ")


@pytest.mark.parametrize(
    "url", ["localhost:9090", "file:///etc/passwd", "http://", "http://u:p@here", "http://here?a=b"]
)
def test_an_address_that_is_none(url: str) -> None:
    with pytest.raises(CommandError, match=r"^--prometheus: found .*; give its address, such as") as raised:
        Prometheus(url)
    assert "u:p" not in str(raised.value)


def test_files_that_can_not_be_used(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no certificate")
    with pytest.raises(CommandError, match=r"^--prometheus-token-file: .*/none cannot be read: No such file"):
        Prometheus("http://here", token_file=str(tmp_path / "none"))
    for name in ("none", "text"):
        with pytest.raises(CommandError, match=rf"^--prometheus-ca-file: .*/{name} cannot be used: "):
            Prometheus("http://here", ca_file=str(tmp_path / name))
