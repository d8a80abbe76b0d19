"""A robot at work and a health tree of 20 leaves that judges it, for benches of detection by a whole tree.

The robot drives to a goal. Each of its parts is a process of its own, so that one can be frozen or slowed while the
others continue.
"""

from __future__ import annotations

import contextlib
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import robot
from bench.counting import least_count, most_count, worst_gap
from bench.robot import Stream
from bench.roles import Role, environment, gate_ports, running

GOAL = "/navigate_to_pose"
FEEDBACK = f"{GOAL}/_action/feedback"
NAVIGATE = "nav2_msgs/action/NavigateToPose"
TASK = {"task_active": {"action": GOAL}}
SETTLE = "1s"
OUTPUTS = ({"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},)
GRACE = 15.0
"""Seconds within which the robot must become healthy for the first time."""
AT_REST = 3.0
"""Seconds without a failure before anything is measured."""

BEFORE = 2.5
"""Seconds before an alarm that contain its reason: more than the longest gap and window."""

STREAMS: Mapping[str, Sequence[Stream]] = {
    "base": (
        Stream("/cmd_vel", "geometry_msgs/msg/Twist", 20),
        Stream(FEEDBACK, f"{NAVIGATE}_FeedbackMessage", 10),
    ),
    "odometry": (Stream("/odom", "nav_msgs/msg/Odometry", 50),),
    "lidar": (Stream("/scan", "sensor_msgs/msg/LaserScan", 15),),
    "imu": (Stream("/imu/data", "sensor_msgs/msg/Imu", 100),),
    "camera": (
        Stream("/base_camera/camera_info", "sensor_msgs/msg/CameraInfo", 15),
        Stream("/wrist_camera/image", "sensor_msgs/msg/Image", 15),
    ),
    "arm": (Stream("/joint_states", "sensor_msgs/msg/JointState", 50),),
    "localization": (
        Stream("/tf", "tf2_msgs/msg/TFMessage", 50, "base_link", ("odom", "base_link")),
        Stream("/tf", "tf2_msgs/msg/TFMessage", 20, "odom", ("map", "odom")),
    ),
    "planner": (
        Stream("/tracking_error", "std_msgs/msg/Float32", 20),
        Stream("/battery_state", "sensor_msgs/msg/BatteryState", 5),
        Stream("/motor_temperature", "sensor_msgs/msg/Temperature", 10),
        Stream("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 5),
    ),
}
"""The streams of the robot's processes. The planner is also a managed node, and logs."""


@dataclass(frozen=True)
class Leaf:
    """One leaf of the tree."""

    path: str
    process: str
    """The process that it judges."""
    body: Mapping[str, Any]
    """The leaf in the short form."""
    stream: str = ""
    """The stream that it judges, if the topic does not identify it."""

    @property
    def kind(self) -> str:
        return next(iter(self.body))

    @property
    def key(self) -> str:
        """The key of the stream that it judges."""
        return self.stream or self.topic

    @property
    def topic(self) -> str:
        """The topic whose messages it judges; empty if it judges none."""
        value = self.body[self.kind]
        found = {
            "topic": value.get("name"),
            "diagnostics": "/diagnostics",
            "transform": "/tf",
            "log": "/rosout",
            "lifecycle": f"{value.get('node')}/transition_event",
            "progress": f"{value.get('action')}/_action/feedback",
            "publisher": "",
            "node": "",
        }
        return str(found.get(self.kind, value.get("topic")))

    @property
    def gap(self) -> float | None:
        """The longest silence, in seconds."""
        return self._duration("gap")

    @property
    def most(self) -> float | None:
        """The greatest age, in seconds."""
        return self._duration("most" if self.kind == "age" else "at_most")

    @property
    def hold_off(self) -> float:
        """Seconds for which the condition must not hold before that is a failure."""
        return self._duration("for") or 0.0

    @property
    def window(self) -> Any:
        """The window of a rate (understudy.trees.core.rate_window)."""
        from understudy.trees.core.rate_window import Band, Window

        value = self.body[self.kind]
        return Window(Band.parse(value["rate"]), self._duration("window") or 0.0) if "rate" in value else None

    def _duration(self, key: str) -> float | None:
        from understudy.api.base import seconds

        value = self.body[self.kind]
        return seconds(value[key]) if key in value else None


def _topic(name: str, type_: str, **limits: str) -> Mapping[str, Any]:
    return {"topic": {"name": name, "type": type_, **limits}}


LEAVES: Sequence[Leaf] = (
    # Judged while there is a goal.
    Leaf("driving/cmd_vel", "base", _topic("/cmd_vel", "geometry_msgs/msg/Twist", gap="300ms")),
    Leaf(
        "driving/tracking_error",
        "planner",
        {"value": {"topic": "/tracking_error", "type": "std_msgs/msg/Float32", "holds": "data < 0.5"}},
    ),
    Leaf("driving/progress", "base", {"progress": {"action": GOAL, "type": NAVIGATE, "gap": "2s"}}),
    # Always judged.
    Leaf("sensors/lidar", "lidar", _topic("/scan", "sensor_msgs/msg/LaserScan", rate="> 10 Hz", window="1s")),
    Leaf(
        "sensors/lidar_age",
        "lidar",
        {"age": {"topic": "/scan", "type": "sensor_msgs/msg/LaserScan", "most": "250ms"}},
    ),
    Leaf("sensors/imu", "imu", _topic("/imu/data", "sensor_msgs/msg/Imu", rate="> 80 Hz", window="1s")),
    Leaf("sensors/odom", "odometry", _topic("/odom", "nav_msgs/msg/Odometry", rate="40 to 60 Hz", window="1s")),
    Leaf("sensors/joint_states", "arm", _topic("/joint_states", "sensor_msgs/msg/JointState", gap="300ms")),
    Leaf("sensors/base_camera", "camera", _topic("/base_camera/camera_info", "sensor_msgs/msg/CameraInfo", gap="1s")),
    Leaf("sensors/wrist_camera", "camera", _topic("/wrist_camera/image", "sensor_msgs/msg/Image", gap="500ms")),
    Leaf(
        "transforms/base_link",
        "localization",
        {"transform": {"parent": "odom", "child": "base_link", "gap": "300ms", "at_most": "250ms"}},
        "base_link",
    ),
    Leaf("transforms/odom", "localization", {"transform": {"parent": "map", "child": "odom", "gap": "1s"}}, "odom"),
    Leaf(
        "state/battery",
        "planner",
        {"value": {"topic": "/battery_state", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.15"}},
    ),
    Leaf(
        "state/motor_temperature",
        "planner",
        {
            "value": {
                "topic": "/motor_temperature",
                "type": "sensor_msgs/msg/Temperature",
                "holds": "temperature < 80",
                "recovers": "temperature < 70",
            }
        },
    ),
    Leaf("state/camera_driver", "planner", {"diagnostics": {"name": "camera: driver", "worst": "WARN"}}),
    Leaf("state/motors", "planner", {"diagnostics": {"prefix": "motors", "worst": "WARN", "for": "300ms"}}),
    Leaf("state/log", "planner", {"log": {"level": "ERROR", "node": "/planner", "quiet": "500ms"}}),
    Leaf("state/planner", "planner", {"lifecycle": {"node": "/planner"}}),
    Leaf("state/speaker", "planner", {"node": {"name": "/speaker"}}),
    Leaf("state/grip_commands", "planner", {"publisher": {"topic": "/grip_commands"}}),
)

ONLY_WITH_A_GOAL = "driving"


def tree() -> dict[str, Any]:
    """Return the health tree in the short form."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for leaf in LEAVES:
        group, name = leaf.path.split("/")
        groups.setdefault(group, []).append({"name": name, **leaf.body})
    return {
        "parallel": [
            {"name": group, "while": TASK, "settle": SETTLE, "do": {"parallel": leaves}}
            if group == ONLY_WITH_A_GOAL
            else {"name": group, "parallel": leaves}
            for group, leaves in groups.items()
        ]
    }


def topics() -> list[str]:
    """Return the topics that are received, each once."""
    return list(dict.fromkeys(leaf.topic for leaf in LEAVES if leaf.topic))


def traffic() -> str:
    """Describe what the robot publishes, for a report."""
    streams = [stream for streams in STREAMS.values() for stream in streams]
    rates = ", ".join(f"{stream.key} {stream.hertz:g}" for stream in streams)
    return (
        f"{sum(stream.hertz for stream in streams):g} messages/s in {len(STREAMS)} processes, jitter {100 * robot.JITTER:g} % of the "
        f"period (standard deviation), UDPv4 only; in Hz: {rates}"
    )


def kinds() -> str:
    """Describe the number of leaves of each kind, for a report."""
    found: dict[str, int] = {}
    for leaf in LEAVES:
        kind = "rate" if leaf.window is not None else "gap" if leaf.kind == "topic" else leaf.kind
        found[kind] = found.get(kind, 0) + 1
    return f"{len(LEAVES)} leaves: {', '.join(f'{count} {kind}' for kind, count in found.items())}"


@contextlib.contextmanager
def at_work() -> Iterator[dict[str, Role]]:
    """Yield the robot's processes and the process that judges it, ``ours``, by name."""
    environment()
    with tempfile.TemporaryDirectory() as folder:
        gated = gate_ports(Path(folder) / "profiles.xml", OUTPUTS)
        with running("bench.leaves", {**{name: {} for name in STREAMS}, "ours": gated}) as roles:
            yield roles


def await_grace(judge: Role) -> None:
    """Wait until the grace, in which some failures do not count, is over and nothing has failed for a while."""
    print(f"waiting for the robot, and until its grace of {GRACE:g} s is over", flush=True)
    begun, state, reason, well = time.monotonic(), "", "it says nothing", 0.0
    while state != "healthy" or time.monotonic() < max(begun + GRACE, well) + AT_REST:
        for told in judge.told_so_far():
            state, reason, well = told["told"], told.get("reason", reason), time.monotonic()
        if time.monotonic() > begun + 120:
            raise SystemExit(f"the robot isn't well, so nothing can be measured: {reason}")
        time.sleep(0.1)


def own_fault(leaf: Leaf, sends: Sequence[Sequence[float]], at: float) -> str:
    """Return why an alarm of a leaf is true, by the times at which its sender stamped and sent its messages; empty if
    it is false.

    ``sends`` has both times of each message; ``at`` is the time of the alarm. All times are Unix seconds.
    """
    before = [(stamped, sent) for stamped, sent in sends if sent <= at]
    times = [sent for _, sent in before]
    if not times:
        return "nothing was sent"
    since = at - BEFORE
    if leaf.gap is not None and (gap := max(worst_gap(times, since), at - times[-1])) >= leaf.gap:
        return f"nothing was sent for {gap * 1000:.0f} ms"
    if (window := leaf.window) is not None:
        # The counts at the alarm, and at each message before it.
        least = min(
            sum(time > at - window.length for time in times), least_count(times, window.length, since) or math.inf
        )
        most = most_count(times, window.length, since) or 0
        if least < window.least:
            return f"{least:g} were sent within {window.length:g} s"
        if window.most is not None and most > window.most:
            return f"{most:g} were sent within {window.length:g} s"
    if leaf.most is not None:
        age = max((sent - stamped for stamped, sent in before if sent > since), default=0.0)
        if age >= leaf.most:
            return f"one was sent {age * 1000:.0f} ms after it had been stamped"
    return ""


def senders_fault(told: Mapping[str, Any], roles: Mapping[str, Role]) -> str:
    """Return why a reported alarm is true, according to the sender's own record; empty if it is false."""
    leaf = next(leaf for leaf in LEAVES if leaf.path == told["leaf"])
    if leaf.gap is None and leaf.window is None and leaf.most is None:
        return ""
    sends = roles[leaf.process].ask("sends", stream=leaf.key)["sends"]
    return own_fault(leaf, sends, told["detected"])


# -- the processes of a run --------------------------------------------------------------------------------------------


def _ours() -> None:
    from bench.judge import judge

    leaves = {leaf.path: leaf.topic for leaf in LEAVES}

    judge({"yaml": tree(), "startupGrace": f"{GRACE:g}s"}, topics(), outputs=OUTPUTS, ip="", leaves=leaves)


def _part(name: str) -> None:
    node = robot.node(name)
    kept = robot.work_on_goals(node, GOAL) if name == "base" else []
    robot.publish(STREAMS[name], node, seed=sorted(STREAMS).index(name))
    del kept


def _planner() -> None:
    from rclpy.lifecycle import LifecycleNode
    from std_msgs.msg import String

    node, gripper = robot.node("robot_state"), robot.node("gripper")
    planner = LifecycleNode("planner")
    planner.trigger_configure()
    planner.trigger_activate()
    planner.create_timer(0.5, lambda: planner.get_logger().info("planning"))
    robot.spin(planner)
    there = {
        "publisher": gripper.create_publisher(String, "/grip_commands", 1),
        "node": robot.node("speaker"),
    }

    def log(asked: Mapping[str, Any]) -> dict[str, Any]:
        at = time.time()
        planner.get_logger().error("no way out")
        return {"at": at}

    def deactivate(asked: Mapping[str, Any]) -> dict[str, Any]:
        at = time.time()
        planner.trigger_deactivate()
        return {"at": at}

    def activate(asked: Mapping[str, Any]) -> dict[str, Any]:
        planner.trigger_activate()
        return {}

    def remove_publisher(asked: Mapping[str, Any]) -> dict[str, Any]:
        gripper.destroy_publisher(there.pop("publisher"))
        return {"at": time.time()}

    def add_publisher(asked: Mapping[str, Any]) -> dict[str, Any]:
        there["publisher"] = gripper.create_publisher(String, "/grip_commands", 1)
        return {}

    def remove_node(asked: Mapping[str, Any]) -> dict[str, Any]:
        there.pop("node").destroy_node()
        return {"at": time.time()}

    def add_node(asked: Mapping[str, Any]) -> dict[str, Any]:
        there["node"] = robot.node("speaker")
        return {}

    answers = (log, deactivate, activate, remove_publisher, add_publisher, remove_node, add_node)
    robot.publish(STREAMS["planner"], node, answers={one.__name__: one for one in answers})


def main() -> None:
    """Run the process with the given name."""
    _, option, name = sys.argv
    assert option == "--role", f"this is run by benches, with --role and one of ours, {', '.join(STREAMS)}"
    if name == "ours":
        _ours()
    elif name == "planner":
        _planner()
    else:
        _part(name)


if __name__ == "__main__":
    main()
