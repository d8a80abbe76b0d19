from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
from navigation_stack import send_signal


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)", "-m", "tested_stack.tested_node"])
    yield started
    started.kill()
    started.wait(10)


def test_a_module_is_found_by_its_full_name(process: subprocess.Popen[bytes]) -> None:
    assert list(send_signal.processes("tested_stack.tested_node")) == [process.pid]
    assert not list(send_signal.processes("tested_stack"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["STOP", "controler_server"], "found controler_server, which is none of map_server, amcl"),
        (["STAND"], "found STAND, give a name such as KILL"),
    ],
)
def test_an_unknown_module_or_signal_is_reported(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["send_signal", *arguments])
    with pytest.raises(SystemExit):
        send_signal.main()
    assert message in capsys.readouterr().err
