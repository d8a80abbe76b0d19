"""What the black box costs while nothing fails: monitors with and without it, over the same messages at the same time.

    scripts/bench blackbox [--seconds 20] [--rounds 5]

One process publishes what a mobile manipulator does, at the rates of the examples and with the jitter of nodes: joint states
at 100 Hz, velocities at 20 Hz, a laser scan at 10 Hz, and compressed images at 5 Hz. Four monitors judge the gaps of these
topics as `scripts/bench monitor` has it, two of them without the images; of each two one has the black box as `blackBox: {}`
asks for. They are measured once their window is full, so that for each message that is kept one is forgotten.

Cost is CPU time over all threads by the kernel's account, and resident memory.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator, Sequence

from bench import cost, robot
from bench.load import priority
from bench.results import Report
from bench.robot import Stream
from bench.roles import Role, await_messages, environment, running
from understudy.api.base import seconds
from understudy.api.recordings import BlackBox

STREAMS = (
    Stream("/joint_states", "sensor_msgs/msg/JointState", 100),
    Stream("/cmd_vel", "geometry_msgs/msg/Twist", 20),
    Stream("/scan", "sensor_msgs/msg/LaserScan", 10),
)
IMAGES = Stream("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", 5)
ALL = (*STREAMS, IMAGES)
OUTPUTS = ({"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},)

WATCHED = {"watching": STREAMS, "recording": STREAMS, "watching_images": ALL, "recording_images": ALL}
"""What each monitor judges."""

BOUNDS = {"CPU": 5.0, "memory": BlackBox().memory_bytes / 1e6}
"""The most that the black box may take more: milli-CPU, MB."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--role", choices=["publishers", *WATCHED], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        _run(options.role)
        return
    report = Report("blackbox")
    environment()
    with _full() as watchers:
        found = cost.measured(lambda: contextlib.nullcontext(watchers), options.rounds, options.seconds)
    for watcher, beside, called in (
        ("recording", "watching", "without images"),
        ("recording_images", "watching_images", "with images"),
    ):
        for name, most in BOUNDS.items():
            unit = cost.UNITS[name]
            more = [one - other for one, other in zip(found[name, watcher], found[name, beside], strict=True)]
            report.figure(f"{name} of the black box, {called}", more, unit=unit, must={"max": most})
            report.figure(f"{name} of the monitor with it, {called}", found[name, watcher], unit=unit)
            report.baseline(f"{name}, {called}", found[name, beside], unit=unit, of="the monitor without it, same run")
        report.figure(f"received, {called}", found["received", watcher], unit=cost.UNITS["received"])
    rates = zip(ALL, robot.sizes(ALL), strict=True)
    report.note("traffic", ", ".join(f"{one.topic} {one.hertz:g} Hz, {size} bytes" for one, size in rates))
    report.note("black box", f"the default: window {BlackBox().window}, memory {BlackBox().memory}; full when measured")
    report.note("priority", priority())
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


@contextlib.contextmanager
def _full() -> Iterator[Sequence[Role]]:
    """The monitors, once each receives all of its topics and has done so for a whole window."""
    with running("bench.blackbox", {"publishers": {}, **{name: {} for name in WATCHED}}) as roles:
        watchers = [roles[name] for name in WATCHED]
        for watcher in watchers:
            await_messages([watcher], sum(stream.hertz for stream in WATCHED[watcher.name]))
        time.sleep(seconds(BlackBox().window))
        yield watchers


# -- the processes of a run --------------------------------------------------------------------------------------------


def _run(role: str) -> None:
    if role == "publishers":
        robot.publish(ALL, robot.node(role))
        return
    from bench.judge import judge

    streams = WATCHED[role]
    leaves = [{"topic": {"name": one.topic, "type": one.type, "gap": "1s"}} for one in streams]
    black_box = {} if role.startswith("recording") else None
    judge({"yaml": {"parallel": leaves}}, [one.topic for one in streams], outputs=OUTPUTS, black_box=black_box)


if __name__ == "__main__":
    main()
