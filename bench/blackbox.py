"""Measures what the black box costs while nothing fails: the same monitors with and without it, over the same messages.

    scripts/bench blackbox [--seconds 15] [--rounds 3]

One process publishes the topics of a mobile manipulator, at the rates of the examples and with the jitter of nodes:
joint states at 100 Hz, velocities at 20 Hz, a laser scan at 10 Hz, and compressed images at 5 Hz. Four monitors
judge the gaps of these topics as in `scripts/bench monitor`, two of them without the images. In each pair, first one
monitor has the black box (`blackBox: {}`), then the other. Each process is compared only with itself, because the
order in which the kernel wakes several processes costs more than the black box. Measurement starts when the window
is full: from then on, for each message that is kept, one is forgotten.

Cost is CPU time over all threads by the kernel's account, and resident memory. A process does not return all memory
when the black box is turned off, so memory is compared between the two monitors of a pair, before the change.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Collection, Sequence

from bench import cost, robot
from bench.load import priority
from bench.results import Report
from bench.robot import Stream
from bench.roles import Role, await_messages, environment, running
from understudy.api.base import seconds
from understudy.api.kinds.recording_spec import BlackBox

STREAMS = (
    Stream("/joint_states", "sensor_msgs/msg/JointState", 100),
    Stream("/cmd_vel", "geometry_msgs/msg/Twist", 20),
    Stream("/scan", "sensor_msgs/msg/LaserScan", 10),
)
IMAGES = Stream("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", 5)
ALL = (*STREAMS, IMAGES)
OUTPUTS = ({"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},)

WATCHED = {"first": STREAMS, "second": STREAMS, "first_images": ALL, "second_images": ALL}
"""The topics that each monitor judges."""

PAIRS = {"without images": ("first", "second"), "with images": ("first_images", "second_images")}
"""By case, the monitor that has the black box first, and the one that has it afterwards."""

BOUNDS = {"CPU": 5.0, "memory": BlackBox().memory_bytes / 1e6}
"""The most that the black box may add: milli-CPU, MB."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a round in seconds")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds before the change, and after it")
    parser.add_argument("--role", choices=["publishers", *WATCHED], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        _run(options.role)
        return
    report = Report("blackbox")
    environment()
    with running("bench.blackbox", {"publishers": {}, **{name: {} for name in WATCHED}}) as roles:
        watchers = [roles[name] for name in WATCHED]
        for watcher in watchers:
            await_messages([watcher], sum(stream.hertz for stream in WATCHED[watcher.name]))
        before, after = (
            _measured(watchers, [pair[place] for pair in PAIRS.values()], options.rounds, options.seconds)
            for place in (0, 1)
        )
    for called, (first, second) in PAIRS.items():
        _told(report, called, before, after, first, second)
    rates = zip(ALL, robot.sizes(ALL), strict=True)
    report.note("traffic", ", ".join(f"{one.topic} {one.hertz:g} Hz, {size} bytes" for one, size in rates))
    report.note("black box", f"the default: window {BlackBox().window}, memory {BlackBox().memory}; full when measured")
    report.note("priority", priority())
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


def _measured(watchers: Sequence[Role], recording: Collection[str], rounds: int, length: float) -> cost.Found:
    """Measure all monitors while those in ``recording`` have the black box, once it is full."""
    for watcher in watchers:
        watcher.ask("record", black_box={} if watcher.name in recording else None)
    time.sleep(seconds(BlackBox().window))
    return cost.measured(lambda: contextlib.nullcontext(watchers), rounds, length)


def _told(report: Report, called: str, before: cost.Found, after: cost.Found, first: str, second: str) -> None:
    """Add a pair of monitors to the report."""
    with_it = [*before["CPU", first], *after["CPU", second]]
    without = [*after["CPU", first], *before["CPU", second]]
    memory = before["memory", first], before["memory", second]
    for name, has, lacks in (("CPU", with_it, without), ("memory", *memory)):
        unit = cost.UNITS[name]
        more = [one - other for one, other in zip(has, lacks, strict=True)]
        report.figure(f"{name} of the black box, {called}", more, unit=unit, must={"mean": BOUNDS[name]})
        report.figure(f"{name} of a monitor with it, {called}", has, unit=unit)
        report.baseline(f"{name}, {called}", lacks, unit=unit, of="a monitor without it, same run")
    report.figure(f"received, {called}", before["received", first], unit=cost.UNITS["received"])


# -- the processes of a run --------------------------------------------------------------------------------------------


def _run(role: str) -> None:
    if role == "publishers":
        robot.publish(ALL, robot.node(role))
        return
    from bench.judge import judge

    streams = WATCHED[role]
    leaves = [{"topic": {"name": one.topic, "type": one.type, "gap": "1s"}} for one in streams]
    judge({"yaml": {"parallel": leaves}}, [one.topic for one in streams], outputs=OUTPUTS)


if __name__ == "__main__":
    main()
