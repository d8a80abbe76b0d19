"""The leaf ``motion``: whether an observer outside the robot sees it move as commanded."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from understudy.kinematics.command_following import Allowance, CommandFollowing, Motion
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import IntervalLeaf, LeafPlace, State
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.core.task_activity import task_timing
from understudy.trees.leaves.leaf_plan import TYPE, Key, LeafKind, LeafPlan, LeafValues, time_key, topic_key
from understudy.trees.source.value_reader import found_text

ODOMETRY = "nav_msgs/msg/Odometry"
COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")

KEPT = 128
"""Greatest number of messages of each topic between two evaluations, which are at most some tenths of a second
apart."""

UNSAID = 1e-4
"""Variance of a velocity whose source states none, in m2/s2 or rad2/s2."""

FASTEST = 100.0
"""Greatest velocity in m/s or rad/s, and greatest acceleration, that a tree may state."""


class MotionLeaf(IntervalLeaf):
    """Holds unless the observed velocity differs from the commanded one by more than the tolerance and the noise
    explain.

    If no observation or no command is received, the difference cannot be determined, and the leaf holds. It also holds
    for an instance that is not in control, because that instance does not cause what the robot does.
    """

    def __init__(self, place: LeafPlace, topic: str, commands: str, allowance: Allowance) -> None:
        """Make a leaf over a topic with the odometry of an observer outside the robot, and a topic with commands."""
        super().__init__(place, topic)
        self._commands, self._allowance = commands, allowance
        self._following = CommandFollowing(allowance)
        self._began = (-math.inf, -math.inf)
        self._last_motions: dict[str, tuple[Content, float]] = {}
        self._unreadable = ""

    def _followed(self) -> CommandFollowing:
        """Return the comparison with everything received up to the time of the evaluation. Each message is used
        once."""
        evaluation = self._evaluation
        found = task_timing(self.tasks, evaluation) if self.tasks else None
        began = (evaluation.since, max(evaluation.since, found.active) if found is not None else evaluation.since)
        if began != self._began and (found is not None or not self.tasks):
            # Another instance commands the robot, or the task begins only now.
            self._began, self._following, self._last_motions = began, CommandFollowing(self._allowance), {}
        self._follow_clock()
        fresh = [
            (content.received, name == self.topic, content)
            for name in (self._commands, self.topic)
            for content in self._fresh(name)
        ]
        for received, seen, content in sorted(fresh, key=lambda entry: entry[:2]):
            try:
                if seen:
                    self._following.see(received, *_motions(content.message()))
                else:
                    self._following.command(received, _commanded(content.message()))
                    self._unreadable = ""
            except (Unreadable, AttributeError, TypeError, ValueError) as error:
                self._unreadable = f"{self.topic if seen else self._commands} cannot be read: {error}"
        return self._following

    def _fresh(self, name: str) -> list[Content]:
        record = self._evaluation.observations.topic(name)
        if record is None or not record.contents:
            return []
        last = self._last_motions.get(name, (None,))[0]
        found: list[Content] = []
        for content in reversed(record.contents):
            if content is last or content.received < self._began[1]:
                break
            found.append(content)
        if found:
            self._last_motions[name] = found[0], found[0].received
        return found[::-1]

    def _follow_clock(self) -> None:
        """Follow a step of the clock, which moved the times of the known messages."""
        steps = [content.received - received for content, received in self._last_motions.values()]
        if any(steps):
            self._following.shift(max(steps, key=abs))
            self._last_motions = {
                name: (content, content.received) for name, (content, _) in self._last_motions.items()
            }

    # -- the state --------------------------------------------------------------------------------------------------

    def _failing(self) -> tuple[float, float] | None:
        """Return the interval in which the leaf fails if nothing more arrives; None if it does not fail."""
        if not self._evaluation.observations.in_control or not self.counts():
            return None
        following = self._followed()
        until = following.until
        if until is None or following.discrepancy(self._evaluation.now) is None:
            return None
        found = task_timing(self.tasks, self._evaluation) if self.tasks else None
        begin = found.settled if found is not None else -math.inf
        return (begin, until) if begin < until else None

    def last(self) -> float | None:
        """Return when the robot was last seen to move as commanded, or when its task became active."""
        well = self._following.well
        return self._last_with_task(well if well is not None and well >= self._evaluation.since else None)

    def _plain_reason(self, state: State) -> str:
        following = self._following
        if state == "Failed" and (found := following.discrepancy(self._evaluation.now)) is not None:
            return f"the robot does not move as {self._commands} commands, according to {self.topic}: {found}"
        if self._unreadable:
            return f"it cannot be determined whether the robot moves as commanded: {self._unreadable}"
        if not following.is_known or following.until is None or self._evaluation.now >= following.until:
            return f"it cannot be determined whether the robot moves as {self._commands} commands: {self.topic} does not show it"
        return f"the robot moves as {self._commands} commands"


def _commanded(message: Any) -> Motion:
    twist = message.twist if hasattr(message, "twist") else message
    return _finite(Motion(twist.linear.x, twist.linear.y, twist.angular.z))


def _motions(message: Any) -> tuple[Motion, Motion]:
    twist, covariance = message.twist.twist, message.twist.covariance
    diagonal = [float(covariance[7 * index]) for index in (0, 1, 5)]
    variances = Motion(*(value if value > 0 else UNSAID for value in diagonal))
    return _finite(Motion(twist.linear.x, twist.linear.y, twist.angular.z)), _finite(variances)


def _finite(motion: Motion) -> Motion:
    if not all(map(math.isfinite, motion)):
        raise ValueError(f"{tuple(motion)} is no velocity")
    return motion


_QUANTITY = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?(m/s2|m/s|rad/s2|rad/s|%)")


def _quantity(unit: str, example: str, least: float = 0.0) -> Callable[[object], float]:
    """Return a function that reads a number with a unit."""

    def read(found: object) -> float:
        match = _QUANTITY.fullmatch(found) if isinstance(found, str) and len(found) <= 32 else None
        if match is None or match[2] != unit:
            raise ValueError(f"found {found_text(found)}; write a number with {unit}, such as {example}")
        value = float(match[1])
        if not least <= value <= FASTEST:
            raise ValueError(f"found {found!r}; give {least:g} to {FASTEST:g} {unit}")
        return value

    return read


def _check(values: LeafValues) -> None:
    type_, topic, commands = values["type"], values["topic"], values["commands"]
    if type_ is not None and type_ not in COMMANDS:
        values.problem("type", f"found {type_!r}; commands are of {' or '.join(COMMANDS)}")
    if topic is not None and topic == commands:
        values.problem("commands", f"found {commands!r}, which is the topic too; give the topic of the commands")


def _plan(values: LeafValues) -> LeafPlan:
    topic, commands = values["topic"], values["commands"]
    allowance = Allowance(
        values["delay"],
        values["window"],
        values["acceleration"],
        values["turn_acceleration"],
        values["slip"] / 100,
        values["tolerance"],
        values["turn_tolerance"],
    )
    return LeafPlan(
        f"{topic.strip('/').removesuffix('/odometry')}.motion",
        WatchedTopic(topic, ODOMETRY, 0.0, None, contents=KEPT, whole=True),
        lambda place: MotionLeaf(place, topic, commands, allowance),
        also=(WatchedTopic(commands, values["type"], 0.0, None, contents=KEPT, whole=True),),
    )


def _quantity_key(name: str, about: str, default: str, least: float = 0.0) -> Key:
    unit = default.split(" ")[1]
    return Key(name, f"{about}, such as {default}", default=default, read=_quantity(unit, default, least))


MOTION = LeafKind(
    "motion",
    "while no observer outside the robot sees it move differently from its commands",
    (
        topic_key("/tracker/robot/odometry", "the odometry from outside the robot, such as /tracker/robot/odometry"),
        topic_key("/cmd_vel", "the topic of the commands, such as /cmd_vel", name="commands"),
        replace(TYPE, about="the type of the commands, geometry_msgs/msg/Twist or TwistStamped"),
        time_key("delay", "the longest time from a command to its visible effect, such as 300ms", default="300ms"),
        time_key("window", "the time over which the observed motion is averaged, such as 500ms", default="500ms"),
        _quantity_key("acceleration", "the least acceleration towards the command", "0.5 m/s2", 0.01),
        _quantity_key("turn_acceleration", "the same for turning", "1 rad/s2", 0.01),
        _quantity_key("slip", "the relative error that is allowed of a velocity", "20 %"),
        _quantity_key("tolerance", "the absolute error that is allowed in addition", "0.03 m/s", 0.001),
        _quantity_key("turn_tolerance", "the same for turning", "0.1 rad/s", 0.001),
    ),
    "{topic: /tracker/robot/odometry, commands: /cmd_vel}",
    _plan,
    _check,
    active_only=True,
)
