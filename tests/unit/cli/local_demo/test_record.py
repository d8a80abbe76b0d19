"""What the records of the robot and of the monitor prove, and what the summary says of them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from understudy.cli.local_demo import command, view
from understudy.cli.local_demo.journals import JournalReader, JournalWriter
from understudy.cli.local_demo.record import MonitorRecord, RobotRecord, failover, leaked, one_at_a_time
from understudy.cli.local_demo.stand import Stand
from understudy.cli.local_demo.summary import Summary


def robot(*commands: tuple[float, str]) -> RobotRecord:
    found = RobotRecord()
    found.add({"at": at, "source": source} for at, source in commands)
    return found


def monitor(*decisions: tuple[float, str]) -> MonitorRecord:
    found = MonitorRecord()
    found.add({"at": at, "control": name} for at, name in decisions)
    return found


def test_a_reader_returns_each_whole_line_once(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    reader = JournalReader(path)
    assert reader.read() == []
    JournalWriter(path).write(source="a")
    with path.open("a") as file:
        file.write('{"at": 1')
    assert [entry["source"] for entry in reader.read()] == ["a"]
    with path.open("a") as file:
        file.write('2, "stopped": true}\n')
    assert reader.read() == [{"at": 12, "stopped": True}]


def test_a_failover_is_measured_from_the_last_command_of_the_frozen_instance() -> None:
    record, found = robot((1.0, "a"), (1.05, "a"), (1.31, "b"), (1.36, "b")), monitor((0.5, "a"), (1.3, "b"))
    found.add([{"at": 1.3, "detected": "a", "reason": "no /cmd_vel for 250 ms"}])
    one = failover(record, found, "a", 1.06, "b")
    assert one.gap == pytest.approx(0.26)
    assert (one.reason, one.stopped) == ("no /cmd_vel for 250 ms", False)
    record.add([{"at": 1.2, "stopped": True}])
    assert failover(record, found, "a", 1.06, "b").stopped
    assert failover(record, found, "a", 1.06, "c").gap is None


def test_two_drivers_are_noticed() -> None:
    decided = monitor((0.5, "a"), (1.3, "b"))
    assert one_at_a_time(robot((1.0, "a"), (1.4, "b")), decided)
    assert not one_at_a_time(robot((1.0, "a"), (1.4, "b"), (1.45, "a")), decided)
    assert not one_at_a_time(robot((1.0, "b"), (1.4, "a")), decided)


def test_commands_of_a_woken_instance_count_only_until_it_is_in_control_again() -> None:
    record = robot((1.0, "a"), (1.3, "b"), (2.1, "a"), (2.6, "a"))
    assert leaked(record, monitor((0.5, "a"), (1.2, "b")), "a", 2.0, 3.0) == 2
    assert leaked(record, monitor((0.5, "a"), (1.2, "b"), (2.5, "a")), "a", 2.0, 3.0) == 1


def test_the_summary_says_whether_the_robot_survived() -> None:
    record, found = robot((1.0, "a"), (1.26, "b")), monitor((0.5, "a"), (1.2, "b"))
    one = failover(record, found, "a", 1.01, "b")
    good = Summary([one], record, found, gap=0.25, within=1.0)
    assert good.is_good
    assert "survived 1 of 1 freeze" in "\n".join(good.lines())
    late = Summary([one], record, found, gap=0.25, within=0.2)
    assert not late.is_good
    record.add([{"at": 1.3, "source": "a"}])
    both = Summary([one], record, found, gap=0.25, within=1.0)
    assert not both.is_good
    assert "TWO DRIVERS" in "\n".join(both.lines())
    nobody = Summary([failover(record, found, "b", 1.4, "c")], record, found, gap=0.25, within=1.0)
    assert not nobody.is_good
    assert "nobody took over" in "\n".join(nobody.lines())


def test_the_strip_shows_when_commands_of_an_instance_reached_the_robot(tmp_path: Path) -> None:
    (tmp_path / "robot.jsonl").write_text(json.dumps({"at": 9.75, "source": "a"}) + "\n")
    stand = Stand(tmp_path, {})
    stand.update()
    assert view.marks(stand, "a", 10.05, 5) == ".|..."
    assert view.marks(stand, "b", 10.05, 5) == "....."


WITHOUT_ROS = """
import sys
for name in ("rclpy", "rosidl_runtime_py", "geometry_msgs", "nav_msgs", "std_msgs"):
    sys.modules[name] = None
sys.argv = ["understudy", "try"]
from understudy.main import main
sys.exit(main())
"""


def test_without_ros_the_command_names_what_to_install() -> None:
    # In a process of its own, in which no module has imported a part of ROS.
    found = subprocess.run([sys.executable, "-c", WITHOUT_ROS], capture_output=True, text=True)
    assert (found.returncode, found.stdout) == (2, "")
    assert found.stderr.startswith(
        "understudy try: ROS 2 is not installed (rclpy, geometry_msgs, nav_msgs, std_msgs not found)"
    )
    assert "pip install '.[ros]'" in found.stderr
    assert "python3-venv" in found.stderr


def test_without_a_keyboard_the_number_of_failures_must_be_given(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda name: name)
    assert command.main(["--failures", "0"]) == 2
    assert "--failures 0 needs a terminal" in capsys.readouterr().err
