"""Runs a real Prometheus, built from its Go module, with given past data."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from testcluster import golang
from testcluster.progress import Progress

SOURCE = Path(__file__).parents[1] / "e2e" / "prometheus"
MODULE = "github.com/prometheus/prometheus/cmd"


def built() -> Path:
    """Build prometheus and promtool, and return their folder."""
    targets = [f"{MODULE}/prometheus", f"{MODULE}/promtool"]
    return golang.build("prometheus", SOURCE, targets, ["-ldflags=-s -w"], Progress(), "five to ten minutes, once")


def promtool(programs: Path, *arguments: str, stdin: str | None = None, within: float = 60) -> None:
    """Run promtool. Raises AssertionError with its output if it fails."""
    command = [str(programs / "promtool"), *arguments]
    done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=within)
    assert done.returncode == 0, done.stdout + done.stderr


def fill(programs: Path, folder: Path, past: str) -> None:
    """Fill the folder with the data of a Prometheus that scraped ``past`` (OpenMetrics with times) and scrapes nothing
    more."""
    (folder / "prometheus.yaml").write_text("{}")
    (folder / "past").write_text(past)
    blocks = ("tsdb", "create-blocks-from", "openmetrics", str(folder / "past"), str(folder / "data"))
    promtool(programs, *blocks, within=600)


def asked(url: str, path: str) -> Any:
    """Return the answer at a path of its API."""
    with urllib.request.urlopen(f"{url}/api/v1/{path}", timeout=60) as answer:
        return json.load(answer)["data"]


@contextlib.contextmanager
def serving(programs: Path, folder: Path, *options: str) -> Iterator[str]:
    """Run a Prometheus with the configuration and the data of this folder for the duration of the context, and yield
    its URL."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [
        str(programs / "prometheus"), f"--config.file={folder / 'prometheus.yaml'}", f"--storage.tsdb.path={folder / 'data'}",
        f"--web.listen-address={address}", *options,
    ]  # fmt: skip
    log = folder / "prometheus.log"
    with log.open("w") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
        try:
            _wait(f"http://{address}", log)
            yield f"http://{address}"
        finally:
            process.terminate()
            process.wait(20)


def _wait(url: str, log: Path) -> None:
    end = time.monotonic() + 30
    while True:
        try:
            asked(url, "status/runtimeinfo")
        except OSError:
            assert time.monotonic() < end, f"Prometheus doesn't answer: {log.read_text()}"
            time.sleep(0.25)
        else:
            return
