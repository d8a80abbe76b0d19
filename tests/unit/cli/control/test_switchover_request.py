"""``understudy failover`` and ``understudy failback``: what they ask for, what they wait for and how they end."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from tests.support.golden import assert_golden
from understudy.api import names
from understudy.api.kinds.robot_workload import Attempt, Moments, Recovery
from understudy.api.kinds.switchover_spec import SwitchoverStatus, parse
from understudy.cli.control import failback, failover, switchover_request

NAME = "robot-17-navigation"


def phase(name: str, message: str, **more: Any) -> dict[str, Any]:
    handled = "ASKED" if name in ("Done", "NotDone") else ""
    found = SwitchoverStatus(
        kind="Failover",
        request="ASKED",
        phase=name,
        message=message,
        since=fleet.ago(0),
        **{"handled": handled} | more,  # type: ignore[arg-type]
    )
    return {"switchover": found.to_wire()}


def record(result: str = "Recovered") -> dict[str, Any]:
    found = Recovery(
        id="r-4",
        number=4,
        reason="failover requested by annotation",
        result=result,  # type: ignore[arg-type]
        strategy="Fallback/Executing",
        from_pod="robot-17-navigation-7k2xq",
        to_pod="robot-17-navigation-x8v2m",
        epoch=42,
        planned=True,
        switchover="Failover",
        moments=Moments(
            last_output=fleet.ago(0.062), fenced=fleet.ago(0.06), routed=fleet.ago(0.06), first_output=fleet.ago(0.01)
        ),
        attempts=[Attempt(strategy="Fallback/Executing", result="Verified")],
    )
    return {"recoveries": [found.to_wire()]}


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(switchover_request, "CHECK_PERIOD", 0.05)


def test_failover_requests_a_switchover_waits_and_reports_the_gap(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell(
        [fleet.well()],
        then=[
            {},
            phase("Preparing", "An understudy is being prepared."),
            phase("Preparing", "An understudy is being prepared."),
            phase("Done", "It took over.", recovery="r-4") | record(),
        ],
    )
    assert failover.main(["--yes", NAME, "-n", "fleet"]) == 0
    assert_golden("control", capsys.readouterr().out.splitlines(), "42", "52 ms")
    (asked,) = [line for line in stand.asked if "annotate" in line]
    found = re.search(
        r"annotate robotworkloads\.understudy\.dev (\S+) --overwrite understudy\.dev/switchover=(.*) --", asked
    )
    assert found is not None
    assert (found[1], parse(found[2]).kind) == (NAME, "Failover")


def test_a_switchover_that_fails_is_reported_with_its_reason(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = "It couldn't begin for 30 s, and nothing was changed: Fallback/Executing: w-2: no /cmd_vel."
    stand.tell([fleet.well()], then=[phase("Waiting", "w-2: no /cmd_vel."), phase("NotDone", reason)])
    assert failback.main(["--yes", NAME]) == 1
    assert capsys.readouterr().out.splitlines()[1:] == ["waiting: w-2: no /cmd_vel.", f"NOT done: {reason}"]
    assert any("understudy.dev/switchover=failback " in line for line in stand.asked)


def test_failback_is_done_if_the_own_instance_is_already_active(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell(
        [fleet.well()], then=[phase("Done", "w-1 of the Deployment, StatefulSet or ReplicaSet is active already.")]
    )
    assert failback.main(["--yes", NAME]) == 0
    assert "done: w-1 of the Deployment, StatefulSet or ReplicaSet" in capsys.readouterr().out


@pytest.mark.parametrize("timeout", ["0", "0s", "-3", "soon", "nan", "inf", ""])
def test_the_timeout_must_be_a_duration(stand: FakeKubectl, capsys: pytest.CaptureFixture[str], timeout: str) -> None:
    with pytest.raises(SystemExit) as ended:
        failover.main(["--yes", NAME, f"--within={timeout}"])
    assert ended.value.code == 2
    assert f"argument --within: found {timeout!r}; give a duration above 0, such as 500ms" in capsys.readouterr().err


@pytest.mark.parametrize("expected", ["0.3", "300ms"])
def test_after_the_timeout_the_command_explains_how_to_withdraw_the_request(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], expected: str
) -> None:
    stand.tell([fleet.well()])
    assert failover.main(["--yes", NAME, "--within", expected]) == 2
    output = capsys.readouterr().err
    assert "its monitor has not started it" in output
    assert f"kubectl annotate robotworkload {NAME} understudy.dev/switchover-" in output


def test_only_one_switchover_runs_at_a_time(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    item = fleet.well()
    item["status"] |= phase("Preparing", "An understudy is being prepared.")
    stand.tell([item])
    assert failover.main(["--yes", NAME]) == 2
    assert '"ASKED" is under way (preparing: ' in capsys.readouterr().err
    assert not any("annotate" in line for line in stand.asked)


def test_without_a_running_monitor_no_switchover_is_requested(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    item = fleet.well()
    for condition in item["status"]["conditions"]:
        if condition["type"] == "Protected":
            condition |= {"status": "False", "reason": "MonitorNotReady"}
    stand.tell([item])
    assert failover.main(["--yes", NAME]) == 2
    assert f"the monitor of {NAME} is not running" in capsys.readouterr().err
    assert not any("annotate" in line for line in stand.asked)


def test_without_a_terminal_a_switchover_has_to_be_confirmed(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell([fleet.well()])
    assert failover.main([NAME]) == 2
    assert "There is no terminal to ask for confirmation: give --yes" in capsys.readouterr().err
    assert not any("annotate" in line for line in stand.asked)


def test_a_server_dry_run_of_a_switchover_waits_for_nothing(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str]
) -> None:
    stand.tell([fleet.well()])
    assert failover.main([NAME, "--dry-run=server"]) == 0
    assert capsys.readouterr().out == "requested (server dry run: nothing was changed)\n"
    assert any("--dry-run=server" in line for line in stand.asked if "annotate" in line)
    assert names.SWITCHOVER not in (stand.item(NAME)["metadata"].get("annotations") or {})


def test_a_missing_workload_is_reported(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    assert failover.main(["--yes", "robot-2"]) == 2
    assert "understudy failover: Error from server (NotFound)" in capsys.readouterr().err


def test_a_gap_that_nobody_observed_is_not_reported(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    found = record()
    del found["recoveries"][0]["moments"]["lastOutput"]
    stand.tell([fleet.well()], then=[{}, phase("Done", "It took over.", recovery="r-4") | found])
    assert failover.main(["--yes", NAME, "-n", "fleet"]) == 0
    assert "at the robot: outputs of the new instance arrive; it was not observed" in capsys.readouterr().out
