"""The robot's log decides whether a recovery was clean, so its reading is checked on logs that are known."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from understudy_demo.robotview import RobotLog, parse


def command(received: float, source: str, sequence: int = 0) -> str:
    record = {
        "event": "command",
        "received": received,
        "source": source,
        "sequence": sequence,
        "sent": received - 0.001,
        "linear": 0.4,
        "angular": 0.0,
        "x": 1.0,
        "y": 2.0,
        "heading": 0.1,
        "speed": 0.39,
    }
    return json.dumps(record)


def log(*commands: tuple[float, str]) -> RobotLog:
    return parse([command(received, source, n) for n, (received, source) in enumerate(commands, 1)])


def drive(source: str, start: float, end: float, period: float = 0.05) -> list[tuple[float, str]]:
    count = round((end - start) / period) + 1
    return [(start + period * n, source) for n in range(count)]


def test_records_are_parsed_and_other_lines_are_ignored() -> None:
    odometry = json.dumps(
        {"event": "odometry", "time": 9.5, "x": 0, "y": 0, "heading": 0, "speed": 0.2, "turn": 0.0, "held": True}
    )
    text = "\n".join(
        [
            "[INFO] [robot]: up",
            command(10.0, "a", 1),
            '{"event": "command", "received": 1',  # cut off
            '{"event": "command", "received": 11.0}',  # incomplete
            '{"event": "started"}',
            "[1, 2]",
            odometry,
            "",
        ]
    )
    read = parse(text)
    assert [(c.received, c.source, c.sequence, c.speed) for c in read.commands] == [(10.0, "a", 1, 0.39)]
    assert [(m.time, m.speed, m.held) for m in read.motions] == [(9.5, 0.2, True)]


def test_lines_with_a_leading_time_stamp_are_parsed() -> None:
    assert parse("2024-11-21T10:00:00Z " + command(1.0, "a")).sources() == ["a"]


def test_commands_are_ordered_by_reception() -> None:
    assert [c.received for c in log((2.0, "a"), (1.0, "a")).commands] == [1.0, 2.0]


def test_a_clean_handover_has_a_gap_and_no_overlap() -> None:
    read = log(*drive("old", 0.0, 10.0), *drive("new", 10.53, 12.0))
    handover = read.handover("old", "new", switch=10.51)
    assert handover.clean
    assert handover.last_old == pytest.approx(10.0)
    assert handover.first_new == pytest.approx(10.53)
    assert handover.gap == pytest.approx(0.53)
    assert handover.overlap == 0.0
    assert handover.trailing == 0.0
    assert not read.returns()


def test_commands_of_the_old_pod_after_the_first_of_the_new_one_overlap() -> None:
    read = log(*drive("old", 0.0, 10.1), *drive("new", 10.02, 12.0))
    handover = read.handover("old", "new", switch=10.01)
    assert not handover.clean
    assert [c.received for c in handover.late] == pytest.approx([10.05, 10.1])
    assert handover.overlap == pytest.approx(0.08)
    assert handover.gap == pytest.approx(0.02)
    assert handover.trailing == pytest.approx(0.09)
    assert [c.received for c in read.returns()] == pytest.approx([10.05, 10.1])


def test_commands_of_the_new_pod_before_the_switch_are_leaks() -> None:
    read = log(*drive("old", 0.0, 10.0), (4.02, "new"), *drive("new", 10.6, 12.0))
    handover = read.handover("old", "new", switch=10.5)
    assert not handover.clean
    assert [c.received for c in handover.early] == [4.02]
    assert handover.first_new == pytest.approx(10.6)
    assert handover.gap == pytest.approx(0.6)
    assert [c.received for c in read.leaks("new", before=10.5)] == [4.02]
    assert read.returns(), "seen from the robot's clock alone, too"


def test_a_command_that_was_sent_before_the_switch_and_arrives_after_it_is_stale() -> None:
    read = log(*drive("old", 0.0, 10.0), *drive("new", 10.6, 12.0))
    (at,) = [n for n, c in enumerate(read.commands) if c.received == 10.6]
    read.commands[at] = replace(read.commands[at], sent=10.2)
    handover = read.handover("old", "new", switch=10.5)
    assert not handover.clean
    assert [(c.sent, c.received) for c in handover.stale] == [(10.2, 10.6)]
    read.commands[at] = replace(read.commands[at], sent=10.45)
    assert read.handover("old", "new", switch=10.5).clean, "within a lifespan of the switch"


def test_a_new_pod_that_never_arrives_is_not_clean() -> None:
    handover = log(*drive("old", 0.0, 1.0)).handover("old", "new", switch=1.5)
    assert not handover.clean
    assert handover.first_new is None
    assert handover.gap is None


def test_a_new_pod_that_only_leaked_is_not_clean() -> None:
    handover = log((0.0, "old"), (0.5, "new"), (1.0, "old")).handover("old", "new", switch=1.5)
    assert handover.first_new is None
    assert len(handover.early) == 1


def test_the_first_source_has_no_gap_before_it() -> None:
    handover = log(*drive("new", 1.0, 2.0)).handover("old", "new")
    assert handover.last_old is None
    assert handover.gap is None


def test_silences_are_listed_with_their_neighbours() -> None:
    read = log(*drive("a", 0.0, 1.0), *drive("b", 1.7, 2.0), *drive("b", 2.3, 2.5))
    assert [(s.before, s.after, round(s.seconds, 3)) for s in read.silences(0.2)] == [("a", "b", 0.7), ("b", "b", 0.3)]
    longest = read.longest_silence()
    assert longest is not None
    assert longest.seconds == pytest.approx(0.7)
    assert log((1.0, "a")).longest_silence() is None


def test_consecutive_commands_of_a_source_form_a_reign() -> None:
    read = log(*drive("a", 0.0, 1.0), *drive("b", 2.0, 3.0))
    assert [(r.source, r.first, r.last, r.count) for r in read.reigns()] == [
        ("a", 0.0, 1.0, 21),
        ("b", 2.0, pytest.approx(3.0), 21),
    ]


def test_a_part_of_the_log_can_be_selected() -> None:
    read = log(*drive("a", 0.0, 10.0)).between(2.0, 3.0)
    assert read.commands[0].received == pytest.approx(2.0)
    assert read.commands[-1].received == pytest.approx(2.95)


def test_sources_can_be_renamed() -> None:
    read = log((1.0, "010fdc53"), (2.0, "010f1111"), (3.0, "010fdc53")).renamed({"010fdc53": "pod-a"})
    assert [c.source for c in read.commands] == ["pod-a", "010f1111", "pod-a"]
    assert [c.received for c in read.commands] == [1.0, 2.0, 3.0]
