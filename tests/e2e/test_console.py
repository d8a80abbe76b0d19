"""``understudy status``, ``timeline``, ``explain`` and ``report`` of a workload that runs and fails, asked for as a user would; and what
``check`` and ``recommend`` say of it as kubectl writes it.
"""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.e2e.console import completed, offline, understudy, watching
from tests.e2e.scenario import Robot, eventually


def judged_as_it_is(robot: Robot, file: Path) -> None:
    """What kubectl writes of a robot that is protected can be checked and weighed, and a fault in it is found."""
    written = robot.kubectl("get", "robotworkloads,failurepolicies,fallbackpools", "-o", "yaml")
    file.write_text(written)
    checked = offline("check", str(file))
    assert checked.returncode == 0, checked.stdout
    assert "3 objects checked in 1 file: 0 errors" in checked.stderr
    weighed = understudy(robot.kubectl, "recommend", str(file), "-o", "json")
    assert weighed.returncode == 0, weighed.stderr
    (found,) = json.loads(weighed.stdout)
    assert (found["workload"], found["present"]) == (robot.workload, "Executing, Restart")
    assert found["order"][0]["strategy"] == "Fallback/Executing"
    file.write_text(written.replace("gap: 500ms", "gap: often"))
    wrong = offline("check", str(file))
    assert wrong.returncode == 1
    assert "'often'" in wrong.stdout


@pytest.mark.own_robot  # nothing has failed yet
def test_the_console_shows_a_robot_before_and_after_a_failure(executing: Robot, tmp_path: Path) -> None:
    kubectl, name = executing.kubectl, executing.workload
    active = executing.wait_protected()
    executing.wait_standby()

    assert completed(kubectl, "explain", name[:3], tmp_path) == [name]
    explained = understudy(kubectl, "explain", name)
    assert explained.returncode == 0, explained.stderr
    assert f"In control: {active} on " in explained.stdout
    written = " ".join(explained.stdout.split())  # lines end where the terminal ends
    assert "1. Fallback from pool quickstart-executing would run: pod " in written
    assert understudy(kubectl, "timeline", name).stdout.strip().endswith("no recoveries yet")

    judged_as_it_is(executing, tmp_path / "fleet.yaml")

    executing.delete(active, force=True)
    recovered = executing.wait_recovered(1)

    wide = understudy(kubectl, "status", "-o", "wide").stdout
    assert "quickstart-executing" in wide
    assert "\x1b" not in wide, "colours are for terminals"
    for verb, form in (("status", "yaml"), ("timeline", "json"), ("explain", "yaml")):
        told = understudy(kubectl, verb, *([name] if verb != "status" else []), "-o", form)
        assert name in json.dumps(yaml.safe_load(told.stdout)), "JSON is YAML too"
    told = understudy(kubectl, "status", "-o", "json")
    (robot,) = json.loads(told.stdout)["robots"]
    assert (robot["name"], robot["active"], robot["epoch"]) == (name, recovered.new, recovered.epoch)
    assert robot["lastRecovery"]["strategy"] == "Fallback/Executing", recovered
    drawn = understudy(kubectl, "timeline", name)
    assert drawn.returncode == 0
    assert " by Fallback/Executing" in drawn.stdout
    assert f"gate epoch {recovered.epoch}" in drawn.stdout

    executing.wait_standby()
    executing.wait_protected()
    shown = understudy(kubectl, "status", name)
    assert shown.returncode == 0, shown.stdout
    assert "1 robot: all protected; 1 healthy" in shown.stdout
    assert understudy(kubectl, "status", "robot-2-drive").returncode == 2

    given = ("--robots=1", "--failures-per-robot-hour=1", f"--recovery-seconds={recovered.seconds:.3f}", "--risk=1%")
    sized = offline("size", *given, "-o", "yaml")
    assert yaml.safe_load(sized.stdout)["needed"]["loss"] == 1, "one fallback is enough for one robot"

    page = tmp_path / "report.html"
    reported = understudy(kubectl, "report", "-o", str(page), "--csv", str(tmp_path))
    assert reported.returncode == 0, reported.stderr
    with (tmp_path / "recoveries.csv").open(newline="") as file:
        rows = {int(row["number"]): row for row in csv.DictReader(file)}
    last = robot["lastRecovery"]
    row = rows[last["number"]]
    assert float(row["recovery_seconds"]) == last["recoverySeconds"]
    assert (row["robot"], row["strategy"], row["reason"]) == (name, last["strategy"], last["reason"])
    assert f'data-value="{last["recoverySeconds"]!r}"' in page.read_text()
    with (tmp_path / "robots.csv").open(newline="") as file:
        (told_of,) = csv.DictReader(file)
    assert (told_of["recoveries_ever"], told_of["protected"]) == (str(len(rows)), "true")
    assert float(told_of["down_seconds"]) >= last["recoverySeconds"] - 1e-6
    assert understudy(kubectl, "report", "-o", str(page), "robot-2-drive").returncode == 2


@pytest.mark.long
def test_status_watch_prints_every_change(executing: Robot, tmp_path: Path) -> None:
    kubectl, name, file = executing.kubectl, executing.workload, tmp_path / "watched"
    active = executing.wait_protected()
    executing.wait_standby()

    def told(words: str) -> list[str]:
        return [
            line for line in file.read_text().splitlines() if f" {kubectl.namespace}/{name}; " in line and words in line
        ]

    with watching(kubectl, file, "status", "-w") as end:
        eventually(lambda: told(f"active {active} (epoch "), within=60, what="who is in control is told")
        executing.delete(active, force=True)
        new = executing.wait_recovered(1)
        number = executing.status()["recoveryCount"]
        driving = f"active {new.new} (epoch {new.epoch})"
        eventually(lambda: told(driving), within=60, what="who took over is told")
        eventually(lambda: told(f"last recovery #{number} "), within=60, what="the recovery is shown")
        executing.wait_protected()
        eventually(
            lambda: "; Healthy; protected; " in told(driving)[-1], within=60, what="that it is protected is told"
        )
        assert end() == 0
    assert "\x1b" not in file.read_text(), "colours are for terminals"


def test_a_shell_accepts_the_completion_script() -> None:
    given = offline("completion", "bash").stdout
    script = 'eval "$1"; complete -p understudy'
    done = subprocess.run(
        ["bash", "-c", script, "bash", given], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("complete ")
