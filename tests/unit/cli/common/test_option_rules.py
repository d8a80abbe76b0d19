"""Options that say nothing where they are given are refused before anything is asked or done."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.fake_kubectl import FakeKubectl
from understudy.cli.doctor import command as doctor
from understudy.cli.inject import command as inject
from understudy.cli.inspect import blackbox, timeline
from understudy.cli.plan import recommend, size

Main = Callable[[list[str]], int]

ROBOT = "robot-17-navigation"
SIZE = ["--robots", "10", "--failures-per-robot-hour", "1", "--recovery-seconds", "1"]

OPTIONS = {"--for": "10s", "--percent": str(inject.PERCENT), "--from": "monitor", "--container": "app"}
TAKEN = {
    "kill": (),
    "freeze": ("--for", "--container"),
    "slow": ("--for", "--percent", "--container"),
    "partition": ("--for", "--from"),
}
MEANT = {
    "--for": "--for applies to freeze, slow and partition",
    "--percent": "--percent applies to slow",
    "--from": "--from applies to partition",
    "--container": "-c/--container applies to freeze and slow",
}


@pytest.mark.parametrize(
    ("fault", "option"), [(fault, option) for fault in TAKEN for option in OPTIONS if option not in TAKEN[fault]]
)
def test_an_option_of_another_fault_is_refused_even_with_its_default_value(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], fault: str, option: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        inject.main([ROBOT, fault, "--yes", option, OPTIONS[option]])
    assert f"understudy inject: error: {MEANT[option]}, not to {fault}\n" in capsys.readouterr().err
    assert stand.asked == []


@pytest.mark.parametrize(("fault", "option"), [(fault, option) for fault in TAKEN for option in TAKEN[fault]])
def test_an_option_of_the_fault_is_accepted(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], fault: str, option: str
) -> None:
    stand.tell([])
    assert inject.main([ROBOT, fault, "--yes", option, OPTIONS[option]]) == 2
    assert "namespace" in stand.asked[-1], "it went as far as asking whether failures may be made here"
    assert "error: -" not in capsys.readouterr().err


def test_the_tests_cover_every_fault() -> None:
    assert set(TAKEN) == set(inject.FAULTS)


@pytest.mark.parametrize(
    ("main", "arguments", "words"),
    [
        (
            blackbox.main,
            [ROBOT, "--fetch", "-o", "text"],
            "blackbox: error: -o/--output applies to the list, not to --fetch",
        ),
        (
            doctor.main,
            ["--no-pods", "--image", "monitor"],
            "doctor: error: --image sets the image of the test pods: remove",
        ),
        (
            timeline.main,
            [ROBOT, "-o", "json", "--last", "3"],
            "timeline: error: --last applies to text only: json contains all",
        ),
        (
            size.main,
            [*SIZE, "--fallbacks", "3", "--risk-of", "loss"],
            "size: error: --risk-of applies to --risk, which is not given",
        ),
        (
            recommend.main,
            ["none.yaml", "--no-cluster", "-n", "fleet"],
            "recommend: error: -n/--namespace cannot be combined with --no-cluster",
        ),
        (
            recommend.main,
            ["none.yaml", "--no-cluster", "--context", "lab"],
            "recommend: error: --context cannot be combined with --no-cluster",
        ),
    ],
)
def test_exclusive_options_of_other_commands_are_refused(
    stand: FakeKubectl,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    main: Main,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert f"understudy {words}" in capsys.readouterr().err
    assert stand.asked == []
