"""Measures what the monitor costs with the policy of examples/mobile_manipulator, compared with callbacks as in
`ros2 topic hz` in the same run.

    scripts/bench manipulator [--seconds 20] [--rounds 3]

One process publishes 10 topics of a mobile manipulator's types at 50 Hz (its IMU at 100 Hz, since the policy
requires more than 80), with the jitter of nodes. A goal of each of its two actions is active, so that every leaf
counts. The unchanged policy judges six of the topics; for each of the other four, a leaf is added to those of the
policy's sensors. Four processes watch the topics at the same time:

- ours: the monitor's own view of the robot in the monitor's process with all that it imports, as in `scripts/bench
  monitor`; the velocities are gated, so they have a port of their own.
- keeping: the same, which also keeps the state of two of the topics, persists it and reports it.
- recording: as ours, with the black box: everything that it received in the last 30 seconds is in its memory.
- callbacks: an rclpy node that does for each topic what `ros2 topic hz` does: a callback stores the time without
  decoding the message; every second the node computes the rate, and the minimum, maximum and spread of the intervals
  of the last second.

Cost is CPU time over all threads by the kernel's account, and resident memory.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench import cost, robot
from bench.load import priority
from bench.results import HERE, Report
from bench.robot import Stream
from bench.roles import Role, await_messages, callbacks, end_with_parent, environment, gate_ports, running

POLICY = HERE.parent / "examples" / "mobile_manipulator" / "policies" / "short.yaml"
ACTIONS = ("/navigate_to_pose", "/arm_controller/follow_joint_trajectory")

STREAMS = (
    Stream("/cmd_vel", "geometry_msgs/msg/Twist", 50),
    Stream("/joint_states", "sensor_msgs/msg/JointState", 50),
    Stream("/scan", "sensor_msgs/msg/LaserScan", 50),
    Stream("/imu/data", "sensor_msgs/msg/Imu", 100),
    Stream("/base_camera/camera_info", "sensor_msgs/msg/CameraInfo", 50),
    Stream("/wrist_camera/camera_info", "sensor_msgs/msg/CameraInfo", 50),
    Stream("/odom", "nav_msgs/msg/Odometry", 50),
    Stream("/wrist_camera/image", "sensor_msgs/msg/Image", 50),
    Stream("/battery_state", "sensor_msgs/msg/BatteryState", 50),
    Stream("/motor_temperature", "sensor_msgs/msg/Temperature", 50),
)
BESIDE = STREAMS[6:]
"""Streams that the policy does not name."""

KEPT = ("/odom", "/joint_states")
BLACK_BOX = {"window": "30s", "memory": "16Mi"}
JUDGES = ("ours", "keeping", "recording")
OUTPUTS = ({"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},)
WINDOW = 1.0
BASELINE = "`ros2 topic hz`-style rclpy callbacks, same run"

PROCESSES: dict[str, dict[str, str]] = {"publishers": {}, "ours": {}, "keeping": {}, "recording": {}, "callbacks": {}}
"""The processes of a run, with their own environment variables in addition to the shared ones."""

DISTURBED: list[str] = []
"""Verdicts of a tree while it was measured. There are none if nothing fails."""


def monitoring() -> dict[str, Any]:
    """Return the policy's monitoring, with a leaf for each topic that it does not name."""
    import yaml

    found: dict[str, Any] = yaml.safe_load(POLICY.read_text())["spec"]["monitoring"]
    sensors = next(node for node in found["yaml"]["parallel"] if node.get("name") == "sensors")
    sensors["parallel"] += [{"topic": {"name": one.topic, "type": one.type, "gap": "1s"}} for one in BESIDE]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a round in seconds")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--role", choices=list(ROLES), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        ROLES[options.role]()
        return
    report = Report("manipulator")
    with tempfile.TemporaryDirectory() as folder:
        environment()
        PROCESSES["ours"] = gate_ports(Path(folder) / "profiles.xml", OUTPUTS)
        found = cost.measured(_watchers, options.rounds, options.seconds)
    cost.told(report, found, cpu=30.0, memory=110.0, baseline=BASELINE)
    cost.more(report, found, "recording", "recorded", cpu=30.0, memory=130.0)
    rates = ", ".join(
        f"{one.topic} {one.hertz:g} Hz, {size} bytes" for one, size in zip(STREAMS, robot.sizes(STREAMS), strict=True)
    )
    report.note(
        "traffic", f"{len(STREAMS)} topics, UDPv4 only, {len(OUTPUTS)} of them gated, serialized sizes: {rates}"
    )
    report.note(
        "tree",
        f"{POLICY.relative_to(HERE.parent)}, both its tasks active, and a gap of 1 s on {', '.join(one.topic for one in BESIDE)}",
    )
    report.note("state", f"of {' and '.join(KEPT)}, at most every 200 ms, persisted every second")
    report.note("black box", f"window {BLACK_BOX['window']}, memory {BLACK_BOX['memory']}")
    report.note("priority", priority())
    for number, text in enumerate(DISTURBED):
        report.note(f"not at rest {number + 1}", text)
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


@contextlib.contextmanager
def _watchers() -> Iterator[Sequence[Role]]:
    """Yield all watchers, once each receives all topics and the tree is healthy with both tasks."""
    with running("bench.manipulator", PROCESSES) as roles:
        watchers = [role for name, role in roles.items() if name != "publishers"]
        await_messages(watchers, sum(stream.hertz for stream in STREAMS))
        for name in JUDGES:
            while roles[name].told(60)["told"] != "healthy":
                pass
        yield watchers
        for name in JUDGES:
            DISTURBED.extend(f"{name}: {told}" for told in roles[name].told_so_far())


# -- the processes of a run --------------------------------------------------------------------------------------------


def _publish() -> None:
    node = robot.node("publishers")
    kept = robot.work_on_goals(node, *ACTIONS)
    robot.publish(STREAMS, node)
    del kept


def _ours(kept: Sequence[str] = (), black_box: Mapping[str, Any] | None = None) -> None:
    from bench.judge import judge

    topics = [stream.topic for stream in STREAMS]
    judge(monitoring(), topics, outputs=OUTPUTS, kept=kept, black_box=black_box)


def _keeping() -> None:
    _ours(KEPT)


def _recording() -> None:
    _ours(black_box=BLACK_BOX)


def _callbacks() -> None:
    end_with_parent()
    shown: dict[str, tuple[float, float, float, float]] = {}

    def look(arrivals: Mapping[str, deque[float]], now: float) -> None:
        for topic, times in arrivals.items():
            while times and times[0] < now - WINDOW:
                times.popleft()
            if len(times) < 2:
                continue
            intervals = [later - earlier for earlier, later in zip(times, list(times)[1:], strict=False)]
            mean = statistics.fmean(intervals)
            shown[topic] = (1 / mean, min(intervals), max(intervals), statistics.pstdev(intervals, mean))

    callbacks({stream.topic: stream.type for stream in STREAMS}, look, every=1.0, raw=True)


ROLES = {"publishers": _publish, "ours": _ours, "keeping": _keeping, "recording": _recording, "callbacks": _callbacks}


if __name__ == "__main__":
    main()
