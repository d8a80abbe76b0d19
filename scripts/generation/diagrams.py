"""Draws the diagrams of the pages, with the names that the code uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import understudy
from scripts.generation.drawing import AMBER, BLUE, INK, PALE, PURPLE, RED, Diagram
from understudy.api.kinds.fallback_pool import Readiness
from understudy.cli.common import palette
from understudy.cli.common.text.time_bars import NAMES


def architecture() -> str:
    """Draw the components between a robot and the application that drives it."""
    drawn = Diagram(
        980,
        445,
        "How Understudy sits between a robot and the software that drives it",
        "The active pod's commands reach the robot through the gate; those of the understudy are stopped there. Both get the robot's "
        "sensor data. A monitor gets the same commands as the robot and switches the gate with one patch. The operator builds and "
        "repairs all of it.",
    )
    drawn.part("the robot")
    drawn.text((119, 48), "robot", size=15, bold=True)
    drawn.box((24, 60), (190, 270), INK, "#f3f6f8")
    drawn.box(
        (44, 84), (150, 72), BLUE, title="base", titled=INK,
        lines=[("reads /cmd_vel on a", BLUE), ("UDP port of its own", BLUE)],
    )  # fmt: skip
    drawn.box((44, 240), (150, 66), PALE, title="sensors, map", titled=INK, lines=[("/odom  /scan  /map", PALE)])

    drawn.part("the gate")
    drawn.text((329, 48), "gate", RED, size=15, bold=True)
    drawn.box((318, 60), (22, 270), RED, "#fdf1ef")
    drawn.text((329, 348), "one NetworkPolicy names the one pod", RED)
    drawn.text((329, 364), "that may send to the gated ports", RED)

    drawn.part("the pods")
    drawn.text((560, 48), "the application's pods (your image, unchanged)", size=15, bold=True)
    _pod(drawn, 76, "active", "drives the robot", "node 1", BLUE, "#e9f2f9")
    _pod(
        drawn, 232, "understudy", "runs in full (or waits, unstarted)", "node 2", PALE, "#f6f6f6", dashed=True, titled="#4a555f"
    )  # fmt: skip

    drawn.part("commands")
    drawn.line([(440, 112), (196, 112)], BLUE, 3.4, head=True)
    drawn.text((392, 104), "commands", BLUE)
    drawn.line([(440, 252), (346, 252)], BLUE, 2.4, dashes="6 5")
    drawn.cross((329, 252))
    drawn.text((392, 244), "commands", BLUE)

    drawn.part("data")
    drawn.line([(194, 290), (438, 290)], PALE, 1.8, head=True)
    drawn.line([(194, 268), (270, 268), (270, 140), (438, 140)], PALE, 1.8, head=True)
    drawn.text((392, 306), "sensor data", PALE)
    drawn.text((392, 156), "sensor data", PALE)

    drawn.part("isolation")
    drawn.line([(560, 164), (560, 228)], RED, 1.6, dashes="3 4")
    drawn.cross((560, 196))
    drawn.text((576, 200), "never hear each other", RED, anchor="start")

    drawn.part("control")
    drawn.text((850, 48), "control", size=15, bold=True)
    drawn.box(
        (740, 70), (220, 76), PURPLE, "#f1ecf7", title="operator",
        lines=[("builds and repairs all of it;", INK), ("not needed for a failover", INK)],
    )  # fmt: skip
    drawn.box(
        (740, 222), (220, 108), AMBER, "#fff8e6", title="monitor", titled="#7d5a08",
        lines=[
            ("one for each workload: reads", INK), ("/cmd_vel at a gated port too,", INK),
            ("so it sees what the robot sees;", INK), ("decides, switches and checks", INK),
        ],
    )  # fmt: skip
    drawn.line([(850, 146), (850, 218)], PURPLE, 1.4, dashes="4 3")
    drawn.line([(740, 94), (684, 94)], PURPLE, 1.4, dashes="4 3")
    drawn.line([(680, 140), (712, 140), (712, 246), (737, 246)], BLUE, 2.2, head=True)

    drawn.part("the switch")
    drawn.line([(850, 330), (850, 408), (329, 408), (329, 376)], RED, 2.4, head=True)
    drawn.text(
        (590, 428), "at a failure: one patch of the gate lets the understudy through and shuts the failed pod out", RED, size=13
    )  # fmt: skip
    return drawn.svg()


def _pod(drawn: Diagram, top: float, name: str, does: str, where: str, colour: str, fill: str, **look: Any) -> None:
    """Draw one of the application's pods, with what it does and where it runs."""
    drawn.box((440, top), (240, 84), colour, fill, title=name, lines=[(does, INK), (where, PALE)], **look)


PARTS = {part: palette.pale(colour) for part, colour in palette.PARTS.items()}
"""The colour of each part of a recovery's time."""

CLOSED, OPENED = (1.5, "cluster", "gate closed"), (1.7, "cluster", "gate opened for F")
RESTORED = (2.2, "reinitialization", "state restored, brought up")

Steps = tuple[tuple[float, str, str], ...]


def _anew(closing: str, starting: str) -> Steps:
    """Return the steps if processes must be started: what happens with the closing of the gate, and what is awaited
    then."""
    return (2.1, "cluster", f"gate closed, {closing}"), (1.5, "startup", starting), RESTORED, OPENED


STEPS: dict[str, tuple[str, Steps]] = {
    "Executing": ("F runs in full, shut out", ((2.6, "cluster", "one patch: P out, F in"),)),
    "Initialized": ("F is up and configured", (CLOSED, RESTORED, OPENED)),
    "Uninitialized": ("F is any pod of the pool", _anew("pod claimed", "processes begin")),
    "Restart": ("nothing waits", _anew("P deleted", "next pod begins")),
}
"""By readiness of the fallback: its description, and the steps after the detection, each with its width, its part and
its text."""

_LEFT, _UNIT, _ROW, _HIGH = 188.0, 78.0, 62.0, 38.0
_DETECTION = 1.35


def failover() -> str:
    """Draw the steps after a failure for each strategy."""
    if set(STEPS) != {*get_args(Readiness), "Restart"} or set(PARTS) != set(NAMES):
        raise ValueError("the strategies or the parts of a recovery are others than the diagram's")
    end = 42 + _ROW * len(STEPS)
    drawn = Diagram(
        980,
        int(end) + 112,
        "What happens at a failure, by each strategy",
        "In every strategy the failure is detected first. With an executing standby one patch of the gate is all that follows. With an "
        "initialized one the gate is closed, state is restored, and the gate is opened for it. With an uninitialized one a pod is "
        "claimed and its processes are started before that. A restart deletes the failed pod and waits for the next "
        "one. Then the outputs at the robot are verified.",
    )
    drawn.part("the failure, and when it is noticed")
    drawn.text((_LEFT, 22), "P fails", RED, anchor="start", size=13, bold=True)
    drawn.line([(_LEFT, 30), (_LEFT, end + 54)], RED, 1.6, dashes="4 4")
    ends = []
    for row, (name, (waits, steps)) in enumerate(STEPS.items()):
        drawn.part(name)
        top = 42 + _ROW * row
        drawn.text((20, top + 17), name, anchor="start", size=14, bold=True)
        drawn.text((20, top + 33), waits, PALE, anchor="start")
        at = _LEFT
        for width, part, words in ((_DETECTION, "detection", "noticed"), *steps):
            drawn.box((at, top), (width * _UNIT - 3, _HIGH), PALE, PARTS[part], lines=[(words, INK)])
            at += width * _UNIT
        ends.append((at, top))
        drawn.line([(at, top + _HIGH / 2), (at + 26, top + _HIGH / 2)], BLUE, 3, head=True)
        drawn.text((at + 34, top + 24), "F drives", BLUE, anchor="start", size=13, bold=True)
    drawn.part("the robot")
    drawn.line([(_LEFT, end + 10), (ends[-1][0], end + 10)], RED, 1.4)
    drawn.text(
        (_LEFT + 8, end + 28), "until then the robot receives nothing, or the policy's safe command; its own watchdog does the rest", RED,
        anchor="start",
    )  # fmt: skip
    drawn.text(
        (_LEFT + 8, end + 46), "then it is verified that its commands are F's and none are P's, or the next strategy's turn comes", INK,
        anchor="start",
    )  # fmt: skip
    drawn.part("legend")
    at = _LEFT
    for part, name in NAMES.items():
        drawn.box((at, end + 74), (16, 16), PALE, PARTS[part])
        drawn.text((at + 24, end + 87), f"t {name}", anchor="start")
        at += 132
    drawn.text((at, end + 87), "not to scale: a patch takes some ms", PALE, anchor="start")
    return drawn.svg()


MODULES: dict[str, tuple[str, ...]] = {
    "observe": ("ros/observe/topic_watch", "monitor/observe/robot/health_observer", "monitor/loop"),
    "judge": ("monitor/judge/stage", "monitor/judge/failure_detection", "trees/core/health_tree"),
    "decide": ("monitor/decide/stage", "failover/decide"),
    "act": (
        "monitor/act/recovery/recovery_runner", "monitor/act/recovery/deferred_recovery", "failover/protocol",
        "failover/strategies/executing",
        "monitor/act/objects/gate_control", "kube/gates/kinds/network_policy", "kube/client",
    ),
    "report": ("monitor/report/recovery_report", "monitor/notices", "monitor/report/status_writer"),
}  # fmt: skip
"""The modules through which a failure passes, by stage and in this order. What follows the patch of the gate is
`report`."""

HANDED = {"observe": "samples", "judge": "judgement", "decide": "resolution", "act": "outcome"}
"""What each stage passes to the next."""


def pipeline() -> str:
    """Draw the monitor's stages, and the modules through which a failure passes from the reader to the patch of the
    gate."""
    folder = Path(understudy.__file__).parent
    if missing := [
        module for modules in MODULES.values() for module in modules if not (folder / f"{module}.py").is_file()
    ]:
        raise ValueError(f"the diagram shows modules that do not exist: {', '.join(missing)}")
    drawn = Diagram(
        1310,
        330,
        "The monitor as a pipeline",
        "Five stages from left to right: observe, judge, decide, act and report. Each hands one value on to the next: samples, a "
        "judgement, a resolution, an outcome. Under each stage are the modules that a failure passes.",
    )
    colours = {"observe": BLUE, "judge": PURPLE, "decide": AMBER, "act": RED, "report": PALE}
    fills = {"observe": "#e9f2f9", "judge": "#f1ecf7", "decide": "#fff8e6", "act": "#fdf1ef", "report": "#f6f6f6"}
    number, left, width = 0, 20.0, 230.0
    for stage, modules in MODULES.items():
        drawn.part(stage)
        drawn.box((left, 40), (width, 44), colours[stage], fills[stage], title=stage, titled=INK)
        for row, module in enumerate(modules):
            number += stage != "report"
            label = f"{number}  {module}" if stage != "report" else module
            drawn.text((left + 2, 112 + 22 * row), label, INK, anchor="start", size=11)
        if stage in HANDED:
            drawn.line([(left + width, 62), (left + width + 28, 62)], INK, 2.2, head=True)
            drawn.text((left + width + 14, 30), HANDED[stage], INK)
        left += width + 32
    drawn.part("the outcome")
    drawn.text(
        (20, 316), "Nothing calls back to the left. What a stage must remember of an outcome, the loop hands to it before the next look.",
        PALE, anchor="start",
    )  # fmt: skip
    return drawn.svg()
