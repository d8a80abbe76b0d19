"""The figures of a campaign and its table per kind of fault."""

from __future__ import annotations

from collections import Counter

from bench.chaos.judge import Injected, Judgement, Violation
from bench.chaos.plan import Fault
from bench.chaos.report import Aftermath, by_kind, kinds_table, summarize


def injected(number: int, kind: str, refused: str = "") -> Injected:
    fault = Fault(number, kind, 5.0, 2.0, 0, "active", 0, 0.5)
    return Injected(fault, 1000.0 + number, 1002.0 + number, "pod-1", refused)


FAULTS = [injected(1, "kill"), injected(2, "freeze"), injected(3, "kill"), injected(4, "kill", "there is none")]
WELL = Aftermath(12.0, [], [], {"monitor (7)": 1.5}, {})


def judgement() -> Judgement:
    found = Judgement("executing-1", fenced=[0.2, 0.4], gaps={"Restart": [3.0]}, recoveries=Counter(Restart=2))
    found.violations.append(Violation("fenced instance", "executing-1", 1003.0, "2 commands", (1, 2)))
    found.violations.append(Violation("gap", "executing-1", 1003.5, "9 s", (3,)))
    return found


def test_a_campaign_without_violations_holds() -> None:
    report = summarize(1, FAULTS, [Judgement("executing-1"), Judgement("restart-2")], WELL, settled_within=120)
    assert report.held
    figures = report.json()["figures"]
    assert figures["faults that were made"]["values"] == [3]
    assert figures["faults that could not be made"]["values"] == [1]
    assert figures["kill: faults made"]["values"] == [2]


def test_each_violation_is_a_figure_and_a_note_with_the_faults_near_it() -> None:
    report = summarize(1, FAULTS, [judgement()], WELL, settled_within=120)
    assert not report.held
    found = report.json()
    missed = {name for name, figure in found["figures"].items() if figure.get("held") is False}
    assert missed == {"commands of fenced instances", "gaps beyond the bound of the strategy"}
    assert "#1 kill active" in found["notes"]["violation 1"]
    assert "#2 freeze active, 2.0 s (pod-1)" in found["notes"]["violation 1"]
    assert found["notes"]["recoveries"] == "2 Restart"


def test_what_is_left_after_the_last_fault_counts() -> None:
    left = Aftermath(125.0, ["restart-2: Failed"], ["pod-9"], {"monitor (7)": 30.0}, {"InvalidHandle: x (agent)": 3})
    found = summarize(1, FAULTS, [Judgement("restart-2")], left, settled_within=120).json()
    missed = {name for name, figure in found["figures"].items() if figure.get("held") is False}
    after = "all healthy and protected after the last fault"
    assert missed == {after, "leaked pods", "growth of a process", "tracebacks"}
    assert found["notes"]["traceback 1"] == "3 times: InvalidHandle: x (agent)"


def test_the_table_counts_violations_near_a_kind_and_those_near_it_alone() -> None:
    rows = by_kind(FAULTS, [judgement()])
    assert (rows["kill"].made, rows["kill"].refused) == (2, 1)
    assert rows["kill"].near == {"fenced instance": 1, "gap": 1}
    assert (rows["kill"].alone, rows["freeze"].alone) == (1, 0)
    assert len(kinds_table(FAULTS, [judgement()]).splitlines()) == 3
