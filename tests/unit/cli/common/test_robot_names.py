"""A RobotWorkload is named as for kubectl."""

from __future__ import annotations

import argparse

import pytest

from understudy.cli.common.cluster_access import kubectl


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser()
    kubectl.add_robot(parser)
    return parser


@pytest.mark.parametrize(
    "typed",
    [
        "robot-1",
        "rw/robot-1",
        "robotworkload/robot-1",
        "RobotWorkloads/robot-1",
        "robotworkloads.understudy.dev/robot-1",
    ],
)
def test_the_kind_may_be_in_front_of_the_name(typed: str) -> None:
    assert _parser().parse_args([typed]).name == "robot-1"


def test_another_kind_is_refused_with_the_way_out(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _parser().parse_args(["deployment/robot-1"])
    assert (
        "'deployment' is not the kind RobotWorkload; give a name, such as robot-1 or rw/robot-1"
        in capsys.readouterr().err
    )
