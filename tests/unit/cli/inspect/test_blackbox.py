"""``understudy blackbox``: what it tells, and that a file is fetched whole or not at all. The monitor that answers is a server of the
same kind.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.fake_monitor import KUBECTL, READY
from tests.support.golden import assert_golden
from understudy.api.kinds.recording_spec import Recording, Recordings
from understudy.cli.inspect.blackbox import lines, main
from understudy.process.http_pages import JSON, Page, serve

FILE = bytes(range(256)) * 4096


def recording(number: int, **more: Any) -> Recording:
    fields: dict[str, Any] = {
        "id": f"{number}abcdef", "number": number, "failed": f"2026-11-22T19:{number:02}:00.250000Z", "reason": "no /cmd_vel for 500 ms",
        "result": "Recovered", "strategy": "Fallback/Executing", "messages": 1234, "size": len(FILE),
        "sha256": hashlib.sha256(FILE).hexdigest(), **more,
    }  # fmt: skip
    return Recording.model_validate(fields)


class Monitor:
    """What a monitor has recorded, and the stand-in for kubectl that leads to it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self.file = folder, folder / "there.mcap"
        self.file.write_bytes(FILE)
        self.recordings = Recordings(workload="robot-1", on=True, recordings=[recording(3), recording(2)])
        self.pages: dict[str, Page] = {"/": lambda: (200, json.dumps(self.recordings.to_wire()), JSON)}
        for one in self.recordings.recordings:
            self.pages[f"/{one.id}.mcap"] = lambda: (200, self.file, "application/octet-stream")

    def reached_by(self, port: int) -> None:
        kubectl = self._folder / "kubectl"
        file = self._folder / "settings.json"
        kubectl.write_text(KUBECTL.format(python=sys.executable, settings=str(file), asked=str(self._folder / "asked")))
        kubectl.chmod(0o755)
        pod = {"metadata": {"name": "monitor-1"}, "status": READY}
        file.write_text(json.dumps({"workload": {}, "pods": [pod], "port": port}))

    @property
    def asked(self) -> str:
        return (self._folder / "asked").read_text()


@pytest.fixture
def monitor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Monitor]:
    (tmp_path / "there").mkdir()
    (tmp_path / "here").mkdir()
    made = Monitor(tmp_path / "there")
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    server = asyncio.run_coroutine_threadsafe(serve(made.pages, 0, host="127.0.0.1"), loop).result(20)
    made.reached_by(server.sockets[0].getsockname()[1])
    monkeypatch.setenv("PATH", str(tmp_path / "there"), prepend=":")
    monkeypatch.chdir(tmp_path / "here")
    yield made
    loop.call_soon_threadsafe(server.close)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(20)


def here() -> list[str]:
    return sorted(path.name for path in Path().iterdir())


def test_recordings_are_listed(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-1", "-n", "fleet"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["NO", "ID", "FAILED", "AGO", "RESULT", "STRATEGY", "MESSAGES", "SIZE", "REASON"]
    assert [row.split()[:4] for row in rows] == [
        ["3", "3abcdef", "2026-11-22", "19:03:00Z"], ["2", "2abcdef", "2026-11-22", "19:02:00Z"],
    ]  # fmt: skip
    columns = ["Recovered", "Fallback/Executing", "1234", "1.05 MB", "no /cmd_vel for 500 ms"]
    assert [re.split(r"  +", row)[-5:] for row in rows] == [columns] * 2
    assert "port-forward pod/monitor-1 :9110" in monitor.asked


@pytest.mark.parametrize("form", ["json", "yaml"])
def test_json_output_contains_all_recordings(monitor: Monitor, capsys: pytest.CaptureFixture[str], form: str) -> None:
    assert main(["robot-1", "-o", form]) == 0
    output = capsys.readouterr().out
    assert output.startswith("{") is (form == "json")
    assert Recordings.model_validate(yaml.safe_load(output)) == monitor.recordings


def test_a_missing_recording_is_explained(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    monitor.recordings = Recordings(workload="robot-1", on=False)
    assert main(["robot-1"]) == 1
    assert_golden("blackbox", capsys.readouterr().out, "spec.blackBox", "FailurePolicy")


def test_omitted_topics_are_named() -> None:
    found = Recordings(workload="robot-1", on=True, left_out={"/image": "too much"})
    printed = list(lines(found, 0.0, columns=None))
    assert_golden("blackbox", printed, "/image", "blackBox.memory")


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (["--fetch"], "robot-1-3.mcap"),
        (["--fetch", "latest"], "robot-1-3.mcap"),
        (["--fetch", "2"], "robot-1-2.mcap"),
        (["--fetch", "2abc"], "robot-1-2.mcap"),
        (["--fetch", "--to", "failure.mcap"], "failure.mcap"),
    ],
)
def test_a_recording_is_fetched(
    monitor: Monitor, capsys: pytest.CaptureFixture[str], arguments: list[str], file: str
) -> None:
    assert main(["robot-1", *arguments]) == 0
    assert Path(file).read_bytes() == FILE
    assert here() == [file]
    assert capsys.readouterr().out.startswith(f"{file}: 1234 messages around failure ")


def test_an_unknown_recording_is_reported(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-1", "--fetch", "7"]) == 2
    output = capsys.readouterr().err
    assert_golden("blackbox", output, "recording 7 of robot-1", "3abcdef (failure 3), 2abcdef (failure 2)")
    monitor.recordings = Recordings(workload="robot-1", on=True)
    assert main(["robot-1", "--fetch"]) == 2
    assert "there is no recording of robot-1" in capsys.readouterr().err


def test_a_number_selects_a_recording_by_number_not_by_id(monitor: Monitor) -> None:
    newest = recording(3).model_copy(update={"id": "2fe3"})
    monitor.recordings = Recordings(workload="robot-1", on=True, recordings=[newest, recording(2)])
    assert main(["robot-1", "--fetch", "2"]) == 0
    assert here() == ["robot-1-2.mcap"]


def test_an_ambiguous_id_prefix_is_refused(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    both = [recording(number).model_copy(update={"id": f"e{number}"}) for number in (3, 2)]
    monitor.recordings = Recordings(workload="robot-1", on=True, recordings=both)
    assert main(["robot-1", "--fetch", "e"]) == 2
    assert_golden("blackbox", capsys.readouterr().err, "robot-1", "e3 (failure 3), e2 (failure 2)")
    assert here() == []


def test_a_target_file_without_fetch_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["robot-1", "--to", "failure.mcap"])
    assert "--to names the file for --fetch" in capsys.readouterr().err


def test_a_damaged_recording_is_refused(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    Path("robot-1-3.mcap").write_bytes(b"an earlier one")
    monitor.file.write_bytes(FILE[:-1] + b"?")
    assert main(["robot-1", "--fetch"]) == 2
    assert_golden("blackbox", capsys.readouterr().err, "3abcdef", "damaged")
    assert here() == ["robot-1-3.mcap"]
    assert Path("robot-1-3.mcap").read_bytes() == b"an earlier one"


def test_a_recording_deleted_during_the_command_is_reported(
    monitor: Monitor, capsys: pytest.CaptureFixture[str]
) -> None:
    del monitor.pages["/3abcdef.mcap"]
    assert main(["robot-1", "--fetch"]) == 2
    assert_golden("blackbox", capsys.readouterr().err, "3abcdef", "gone")
    assert here() == []


def test_a_file_that_cannot_be_written_is_reported(monitor: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robot-1", "--fetch", "--to", "none/such.mcap"]) == 2
    assert_golden("blackbox", capsys.readouterr().err, "3abcdef", "none/such.mcap")
