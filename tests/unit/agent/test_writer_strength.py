"""An instance knows how strong its writers are, and a restarted process is weaker than the one before it."""

from __future__ import annotations

from pathlib import Path

from understudy.agent.writer_strength import WriterStrengths
from understudy.api.protocol.ownership_strength import BEGIN, PER_SECOND, STRONGEST, strength

START = BEGIN + 1000.0
FILE = "<dds><ownershipStrength><value>{}</value></ownershipStrength><name>x</name></dds>"


class Clock:
    now = START

    def __call__(self) -> float:
        return self.now


def process(number: int, writer: int = 0) -> bytes:
    return bytes([1, 15, *[number] * 10, *[writer] * 4])


def prepared(directory: Path) -> tuple[WriterStrengths, Clock]:
    (directory / "profiles.xml").write_text(FILE.format(strength(START)))
    clock = Clock()
    return WriterStrengths(directory, clock=clock), clock


def written(directory: Path) -> int:
    return int((directory / "profiles.xml").read_text().split("value>")[1].split("<")[0])


def test_every_new_instance_is_weaker_than_all_earlier_ones() -> None:
    assert strength(BEGIN) == STRONGEST
    assert strength(START) - strength(START + 1) == PER_SECOND
    assert strength(BEGIN - 5) == STRONGEST, "a clock that is not set yet makes no strength that can't be sent"
    assert strength(BEGIN + STRONGEST) == 0


def test_the_first_process_has_the_prepared_strength(tmp_path: Path) -> None:
    strengths, clock = prepared(tmp_path)
    clock.now += 7  # it takes a while to start
    assert not strengths.saw([])
    assert written(tmp_path) == strength(START), "nothing changes before it is up"
    assert strengths.saw([process(1), process(1, writer=2)])
    assert strengths.range == (strength(START), strength(START))


def test_a_process_that_starts_later_reads_a_lower_strength(tmp_path: Path) -> None:
    strengths, clock = prepared(tmp_path)
    strengths.saw([process(1)])
    clock.now += 60
    assert not strengths.saw([process(1)]), "the running one is as strong as before"
    assert written(tmp_path) == strength(START + 60)
    clock.now += 2
    assert strengths.saw([process(1), process(2)])
    assert strengths.range == (strength(START + 62), strength(START)), "what both may have"


def test_a_restarted_agent_continues_from_the_last_strength(tmp_path: Path) -> None:
    strengths, clock = prepared(tmp_path)
    strengths.saw([process(1)])
    clock.now += 30
    strengths.saw([process(1)])
    again = WriterStrengths(tmp_path, clock=clock)
    assert again.range == strengths.range == (strength(START), strength(START))
    assert not again.saw([process(1)])


def test_after_a_standby_took_over_a_restarted_process_offers_nothing_that_the_robot_accepts(tmp_path: Path) -> None:
    strengths, clock = prepared(tmp_path)
    file = tmp_path / "profiles.xml"
    deadline = "<deadline><period><sec>0</sec></period></deadline>"
    file.write_text(file.read_text().replace("<name>", deadline + "<name>"))
    strengths.saw([process(1)])
    strengths.give_way()
    strengths.give_way()
    clock.now += 30
    strengths.saw([process(1)])
    assert file.read_text() == FILE.format(strength(START + 30)), "and it stays so while the strength falls"


def test_a_clock_that_was_set_back_makes_no_process_stronger(tmp_path: Path) -> None:
    strengths, clock = prepared(tmp_path)
    strengths.saw([process(1)])
    clock.now -= 500
    strengths.saw([process(1)])
    assert written(tmp_path) == strength(START)
    strengths.saw([process(2)])
    assert strengths.range == (strength(START), strength(START)), "it read what was in the file"


def test_profiles_without_strengths_give_no_strength(tmp_path: Path) -> None:
    strengths = WriterStrengths(tmp_path)
    assert not strengths.saw([process(1)])
    (tmp_path / "profiles.xml").write_text("<dds/>")
    assert not strengths.saw([process(1)])
    assert strengths.range is None
