"""``understudy inject``: where it is allowed, and what it runs for each fault."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.cli.inject import command as inject
from understudy.cli.inject import fault_commands

ROBOT = "robot-17-navigation"


def namespace(**labels: str) -> dict[str, Any]:
    return {"kind": "Namespace", "metadata": {"name": "fleet", "labels": labels}}


@pytest.mark.parametrize("labels", [{}, {inject.ALLOWED: "false"}])
def test_faults_are_injected_only_if_the_namespace_allows_it(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], labels: dict[str, str]
) -> None:
    stand.tell([fleet.well(), namespace(**labels)])
    assert inject.main([ROBOT, "kill", "--yes"]) == 2
    assert_golden("inject", capsys.readouterr().err, "namespace fleet understudy.dev/allow-inject=true")
    assert not any(line.startswith("delete ") for line in stand.asked)


def test_the_active_pod_is_killed(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    item = fleet.well()
    stand.tell([item, namespace(**{inject.ALLOWED: "true"})])
    assert inject.main([ROBOT, "kill", "--yes"]) == 0
    assert any(f"delete pod {item['status']['active']} --grace-period=0 --force" in line for line in stand.asked)
    assert f"understudy timeline -n fleet {ROBOT}" in capsys.readouterr().out


def test_the_container_ends_a_freeze_itself(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    item = fleet.well()
    stand.tell([*fleet.around(item), namespace(**{inject.ALLOWED: "true"})])
    assert inject.main([ROBOT, "freeze", "--for", "50ms", "--yes"]) == 0
    asked = "\n".join(stand.asked)
    assert f"exec {item['status']['active']} -c app -- sh -c {fault_commands.FREEZE_AND_SLOW.splitlines()[0]}" in asked
    assert " sh 1 0.05 0\n" in f"{asked}\n"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--for", "soon"], '--for "soon": write a duration'),
        (["--for", "11m"], "up to 600 s"),
        (["--for", "0s"], "a duration above 0"),
    ],
)
def test_the_duration_is_required(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    assert inject.main([ROBOT, "freeze", "--yes", *more]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("percentage", ["0", "100", "-1", "half", "50%"])
def test_an_invalid_percentage_is_refused_in_one_line(capsys: pytest.CaptureFixture[str], percentage: str) -> None:
    with pytest.raises(SystemExit) as ended:
        inject.main([ROBOT, "slow", "--yes", f"--percent={percentage}"])
    assert ended.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert_golden("inject", message, "--percent", repr(percentage), "99", "100")


@pytest.mark.parametrize(("length", "percent"), [(10.0, 80), (0.1, 50), (3.0, 99), (2.0, 100)])
def test_a_slow_application_is_stopped_for_its_share_of_the_time(length: float, percent: int) -> None:
    count, stopped, running = fault_commands.cycles(length, percent)
    assert count * (stopped + running) == pytest.approx(length)
    assert count * stopped == pytest.approx(length * percent / 100)
