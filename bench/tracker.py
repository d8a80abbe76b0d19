"""Measures the tracker and the leaf `motion` on a rendered robot: how exact poses and speeds are, how soon a stop is
detected, and whether ordinary driving raises a false alarm.

    scripts/bench tracker [--minutes 10] [--stops 40]

All times are simulation time, so nothing depends on the speed of this machine. Images are really rendered and
markers really detected; each message of the tracker comes `LATENCY` after its image was taken.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist
from tracker_scene import MOUNTED, Fault, Pose, Scene
from tracker_scene.driving import PERIOD, Base, Driver

from bench.results import Report
from understudy.tracker.configuration import Configuration, load
from understudy.tracker.image_messages import Calibration
from understudy.tracker.robot_location import Locator
from understudy.tracker.tracker_node import odometry_of
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.short import health_loader

ODOMETRY, COMMANDS = "/tracker/robot/odometry", "/cmd_vel"
LATENCY = 0.06
PLACES = 300
STEP = 0.01
IMAGES = 0.1

CONFIGURATION = f"""
camera:
  image: /camera/image_raw
  pose: {{x: 0, y: 0, z: 3, pitch: {math.pi / 2}, yaw: {math.pi / 2}}}
markers:
  - {{name: robot, id: 7, size: 0.2, height: 0.2, mounted: {{x: {MOUNTED[0]}}}}}
"""


@dataclass
class Received:
    """A message that was received at a time of the simulation."""

    received: float
    said: object

    def message(self) -> object:
        return self.said

    def age(self) -> float | None:
        return None

    def older(self, stamp: float) -> float:
        return self.received - stamp

    def mentions(self, text: str) -> bool:
        return True


@dataclass
class Supervised:
    """A robot in its scene, the tracker that sees it, and the leaf that judges it."""

    scene: Scene
    configuration: Configuration = field(default_factory=lambda: load(CONFIGURATION))
    leaf: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.base = Base(self.scene)
        self.locator = Locator(self.configuration)
        self.locator.calibrate(Calibration(np.array(Scene.matrix()).reshape(3, 3), np.zeros(5), False, 640, 480))
        self.tree = health_loader.load({"motion": {"topic": ODOMETRY, "commands": COMMANDS, **self.leaf}})
        self.records = {topic.name: TopicRecord(0.0, topic.contents) for topic in self.tree.topics}
        self.images = self.seen = 0
        self.locating = 0.0
        self._coming: list[tuple[float, str, object]] = []
        self._next_image = self._next_command = 0.0
        self.odometry: Any = None

    def step(self, command: tuple[float, float] | Driver) -> Verdict:
        """Advance by STEP with a command, and judge."""
        now = self.scene.time
        if now >= self._next_command - 1e-9:
            self._next_command += PERIOD
            speed, turn = command.command() if isinstance(command, Driver) else command
            self.base.command(speed, turn)
            twist = Twist()
            twist.linear.x, twist.angular.z = float(speed), float(turn)
            self._coming.append((now + 0.003, COMMANDS, twist))
        if now >= self._next_image - 1e-9:
            self._next_image += IMAGES
            self._look(now)
        self.base.step(STEP)
        now = self.scene.time
        for due in sorted((entry for entry in self._coming if entry[0] <= now), key=lambda entry: entry[0]):
            self.records[due[1]].add(due[0])
            self.records[due[1]].contents.append(Received(due[0], due[2]))
        self._coming = [entry for entry in self._coming if entry[0] > now]
        return self.tree.evaluate(RecordedObservations(self.records), now=now, since=0.0)

    def _look(self, now: float) -> None:
        image = cv2.cvtColor(self.scene.image(), cv2.COLOR_RGB2GRAY)
        self.images += 1
        begun = time.process_time()
        sightings = self.locator.see(image, now)
        self.locating += time.process_time() - begun
        self.odometry = None
        if sightings:
            self.seen += 1
            stamp = Time(sec=int(now), nanosec=round(now % 1 * 1e9) % 1_000_000_000)
            self.odometry = odometry_of(sightings[0], "map", stamp)
            if self.odometry is not None:
                self._coming.append((now + LATENCY, ODOMETRY, self.odometry))


def stop(seed: int, fault: Fault = "stands", speed: float = 0.3, **leaf: str) -> tuple[float | None, Verdict]:
    """Return the seconds from the robot's stop (or another fault) to its detection, and the verdict; None if it takes
    more than 5 s.

    The robot drives straight. Its commands continue, but from some time on they do not reach it.
    """
    random = np.random.default_rng(seed)
    scene = Scene(Pose(-1.4, float(random.uniform(-0.8, 0.8)), float(random.uniform(-0.1, 0.1))), seed=seed)
    supervised = Supervised(scene, leaf=leaf)
    try:
        lost = 3.0 + float(random.uniform(0, 0.1))
        while scene.time < lost:
            if (verdict := supervised.step((speed, 0.0))).state != "Healthy":
                raise AssertionError(f"a false alarm at {scene.time:.2f} s: {verdict.reason}")
        scene.fault = fault
        stopped: float | None = None if fault == "stands" else scene.time
        while scene.time < lost + 5.0:
            verdict = supervised.step((speed, 0.0))
            if stopped is None and abs(scene.motion[0]) < 0.1 * speed:
                stopped = scene.time
            if verdict.state == "Failed":
                return scene.time - (stopped if stopped is not None else scene.time), verdict
        return None, verdict
    finally:
        scene.close()


@dataclass
class Ordinary:
    """The result of ordinary driving."""

    minutes: float = 0.0
    images: int = 0
    seen: int = 0
    alarms: list[str] = field(default_factory=list)
    locating: float = 0.0
    """ms of computation per image."""


def ordinary(minutes: float, seed: int = 0, *, leaves: bool = True, **leaf: str) -> Ordinary:
    """Drive around for some minutes of simulated time."""
    scene = Scene(seed=seed)
    supervised = Supervised(scene, leaf=leaf)
    driver, found = Driver(scene, seed, leaves=leaves), Ordinary(minutes)
    was = "Healthy"
    try:
        while scene.time < minutes * 60:
            verdict = supervised.step(driver)
            if verdict.state != was and verdict.state == "Failed":
                found.alarms.append(f"{scene.time:.2f} s: {verdict.reason}")
            was = verdict.state
        found.images, found.seen = supervised.images, supervised.seen
        found.locating = 1000 * supervised.locating / supervised.images
        return found
    finally:
        scene.close()


def exactness(count: int, seed: int = 0) -> tuple[list[tuple[float, float]], int]:
    """Return the errors of the place (m) and the heading (rad) of a standing robot, and how often it is not seen."""
    random = np.random.default_rng(seed)
    scene, missed, errors = Scene(seed=seed), 0, []
    supervised = Supervised(scene)
    try:
        for index in range(count):
            scene.put(Pose(random.uniform(-1.6, 1.6), random.uniform(-1.2, 1.2), random.uniform(-math.pi, math.pi)))
            found = supervised.locator.see(cv2.cvtColor(scene.image(), cv2.COLOR_RGB2GRAY), float(index))
            if not found:
                missed += 1
                continue
            placed, true = found[0].placed, scene.pose
            off = math.hypot(placed.x - true.x, placed.y - true.y)
            errors.append((off, abs(math.remainder(placed.heading - true.heading, math.tau))))
        return errors, missed
    finally:
        scene.close()


def speeds(
    seed: int, speed: float = 0.3, turn: float = 0.0, seconds: float = 6.0
) -> list[tuple[float, float, float, float]]:
    """Return each velocity over a window of steady driving: forward in m/s and turn in rad/s, as seen and as they
    really were."""
    scene = Scene(Pose(-1.0, -0.6, 0.2), seed=seed)
    supervised, found = Supervised(scene), []
    true: list[Pose] = []
    try:
        while scene.time < seconds:
            before = supervised.odometry
            supervised.step((speed, turn))
            true.append(scene.pose)
            odometry, window = supervised.odometry, supervised.configuration.window
            if odometry is not None and odometry is not before and scene.time > 2.0:
                # The time of the image that was taken before this step.
                now, then = true[-2], true[-2 - round(window / STEP)]
                turned = math.remainder(now.heading - then.heading, math.tau)
                chord = math.hypot(now.x - then.x, now.y - then.y)
                arc = chord * (turned / 2) / math.sin(turned / 2) if turned else chord
                twist = odometry.twist.twist
                found.append((twist.linear.x, twist.angular.z, arc / window, turned / window))
        return found
    finally:
        scene.close()


def picture(file: Path) -> None:
    """Draw the camera's view of a robot that has driven a curve, with the tracker's results in it."""
    scene = Scene(Pose(-1.0, -0.7, 0.1), seed=5)
    supervised, trail = Supervised(scene), []
    matrix = np.array(Scene.matrix()).reshape(3, 3)
    view = supervised.locator.view
    assert view is not None, "its pose is configured"

    def pixel(*place: float) -> tuple[int, int]:
        x, y, z = matrix @ ((np.array(place) - view.place) @ view.axes)
        return round(x / z), round(y / z)

    try:
        while scene.time < 6.0:
            supervised.step((0.3, 0.35))
            if supervised.odometry is not None:
                where = supervised.odometry.pose.pose.position
                trail.append((where.x, where.y))
        image = scene.image()[:, :, ::-1].copy()
        (sighting,) = supervised.locator.see(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), scene.time)
    finally:
        scene.close()
    placed, velocity = sighting.placed, sighting.velocity
    assert velocity is not None, "it was seen all the time"
    green, orange = (70, 200, 60), (30, 140, 250)
    cv2.polylines(image, [np.array([pixel(x, y, 0.0) for x, y in trail])], False, orange, 2, cv2.LINE_AA)
    cv2.polylines(image, [sighting.corners.round().astype(int)], True, green, 2, cv2.LINE_AA)
    ahead = (placed.x + 0.45 * math.cos(placed.heading), placed.y + 0.45 * math.sin(placed.heading))
    cv2.arrowedLine(image, pixel(placed.x, placed.y, 0.2), pixel(*ahead, 0.2), green, 2, cv2.LINE_AA, tipLength=0.2)
    spread, fast = np.sqrt(np.diag(placed.covariance)), math.sqrt(velocity.covariance[0][0])
    lines = [
        f"marker {sighting.marker.id}: {placed.x:+.3f} {placed.y:+.3f} m +- {1000 * spread[0]:.1f} mm",
        f"{velocity.forward:.3f} m/s +- {1000 * fast:.1f} mm/s, {velocity.turn:+.2f} rad/s +- {math.sqrt(velocity.turn_variance):.2f}",
    ]
    cv2.rectangle(image, (6, 4), (440, 52), (235, 235, 235), cv2.FILLED)
    for index, line in enumerate(lines):
        cv2.putText(image, line, (12, 24 + 20 * index), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    cv2.imwrite(str(file), image)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--stops", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--picture", type=Path, help="only write an image of the camera, with what the tracker detected in it"
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.picture is not None:
        picture(arguments.picture)
        return 0
    report = Report("tracker")
    errors, missed = exactness(PLACES, arguments.seed)
    places, headings = zip(*errors, strict=True)
    report.figure("place", [1000 * value for value in places], unit="mm", must={"p95": 5.0})
    report.figure("heading", [math.degrees(value) for value in headings], unit="degrees", must={"p95": 2.0})
    report.note(
        "places",
        f"a standing robot at {PLACES} random places and headings, {missed} of which weren't seen in one image",
    )
    for speed, turn in ((0.3, 0.0), (0.3, 0.4)):
        found = speeds(arguments.seed, speed, turn, seconds=12.0)
        name = f"at {speed:g} m/s and {turn:g} rad/s"
        report.figure(f"speed {name}", [1000 * abs(v - u) for v, _, u, _ in found], unit="mm/s", must={"p95": 10.0})
        report.figure(f"turn {name}", [abs(w - x) for _, w, _, x in found], unit="rad/s", must={"p95": 0.05})
    found_after = [stop(seed)[0] for seed in range(arguments.stops)]
    report.figure(
        "stop found after",
        [value if value is not None else math.inf for value in found_after],
        unit="s",
        must={"max": 1.0},
        limit="infinite where not within 5 s",
    )
    result = ordinary(arguments.minutes, arguments.seed)
    report.figure("false alarms", [len(result.alarms)], unit=f"in {result.minutes:g} min", must={"max": 0})
    report.figure("computing", [result.locating], unit="ms an image")
    report.note(
        "driving",
        f"ordinary, with turns, stops, up to 12 % slip, and out of the picture: the robot was seen in {result.seen} of "
        f"{result.images} images{''.join(f'; {alarm}' for alarm in result.alarms)}",
    )
    report.note("time", f"simulated; images at {1 / IMAGES:g} Hz, their odometry {1000 * LATENCY:g} ms later")
    print(report.table())
    print(report.write())
    return 0 if report.held else 1


if __name__ == "__main__":
    sys.exit(main())
