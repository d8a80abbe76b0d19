"""A person in front of the robot: sets the stack's initial pose, sends goals, and knows the true pose."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from navigation_stack.names import NODES
from navigation_stack.poses import Pose

from tests.unit.processes import Run, stop

REPOSITORY = Path(__file__).parents[3]
SOURCES = (REPOSITORY / "examples" / "navigation" / "src", REPOSITORY / "operator")


class Site(Run):
    """A robot and what drives it, as processes over loopback, and one person."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        super().__init__(folder, stack, SOURCES)
        self.module("navigation_robot")

    def module(self, name: str, **more: str) -> subprocess.Popen[bytes]:
        return self.start(name, "-m", name, **more)

    def end(self, process: subprocess.Popen[bytes]) -> None:
        """Stop the stack, which then ends its own child processes."""
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
        stop(process)

    def person(self) -> Person:
        for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION"):
            os.environ[name] = self.environment[name]
        made = Person(int(self.environment["ROS_DOMAIN_ID"]))
        self._stack.callback(made.close)
        return made


DOUBT = 0.35
"""Standard deviation in m and rad of a person's estimate of the robot's pose."""


class Person:
    def __init__(self, domain: int) -> None:
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
        from nav2_msgs.action import NavigateToPose
        from navigation_stack.conversions import pose_of
        from navigation_stack.managed import LATCHED
        from rclpy.action import ActionClient
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_msgs.msg import Header

        context = Context()
        context.init(args=[], initialize_logging=False, domain_id=domain)
        self._context = context
        self._node = Node("person", context=context, use_global_arguments=False, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self.truth: list[Pose] = []
        self.believed: list[tuple[Pose, Any]] = []
        self.heartbeats = 0

        def beaten(message: Header) -> None:
            self.heartbeats += 1

        self._node.create_subscription(
            PoseStamped, "/ground_truth/pose", lambda message: self.truth.append(pose_of(message.pose)), 10
        )
        self._node.create_subscription(
            PoseWithCovarianceStamped,
            "/amcl_pose",
            lambda message: self.believed.append((pose_of(message.pose.pose), message)),
            LATCHED,
        )
        self._node.create_subscription(Header, "/navigation/heartbeat", beaten, 10)
        self._initial = self._node.create_publisher(PoseWithCovarianceStamped, "/initialpose", 1)
        self._client = ActionClient(self._node, NavigateToPose, "/navigate_to_pose")
        self._clients: dict[tuple[str, str], Any] = {}
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=5)
        self._thread.join(5)
        self._node.destroy_node()
        self._context.try_shutdown()

    # -- lifecycle --------------------------------------------------------------------------------------------------

    def _called(self, kind: Any, name: str, request: Any, within: float = 2.0) -> Any:
        client = self._clients.get((name, kind.__name__))
        if client is None:
            client = self._clients[(name, kind.__name__)] = self._node.create_client(kind, name)
        if not client.wait_for_service(timeout_sec=within):
            return None
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        return future.result() if done.wait(within) else None

    def state(self, node: str) -> str:
        from lifecycle_msgs.srv import GetState

        answer = self._called(GetState, f"/{node}/get_state", GetState.Request())
        return "" if answer is None else str(answer.current_state.label)

    def bring(self, site: Site, transition: str, state: str, nodes: list[str] = NODES) -> None:
        """Bring nodes from one state into another, by a transition."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.id = getattr(Transition, f"TRANSITION_{transition.upper()}")
        for node in nodes:
            # An answer can be lost while the graph is young: the state tells.
            site.wait(
                f"{node} is {state}",
                lambda node=node: (
                    self.state(node) == state
                    or (self._called(ChangeState, f"/{node}/change_state", request) and self.state(node) == state)
                ),
            )

    # -- navigation -------------------------------------------------------------------------------------------------

    def set_pose(self, pose: Pose) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from navigation_stack.conversions import message_of

        message = PoseWithCovarianceStamped()
        message.header.frame_id = "map"
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.pose.pose = message_of(pose)
        for i in (0, 7, 35):  # as RViz does, a person says that it is about there
            message.pose.covariance[i] = DOUBT**2
        self._initial.publish(message)

    def restore(self, message: Any) -> None:
        """Publish a pose that another instance had published, with the time at which it was valid."""
        self._initial.publish(message)

    @property
    def localizable(self) -> bool:
        return self._initial.get_subscription_count() > 0

    def goal(self, pose: Pose) -> Errand:
        from nav2_msgs.action import NavigateToPose
        from navigation_stack.conversions import stamped

        assert self._client.wait_for_server(timeout_sec=20)
        request = NavigateToPose.Goal(pose=stamped(pose, "map", self._node.get_clock().now().to_msg()))
        errand = Errand()
        sent = self._client.send_goal_async(request, feedback_callback=errand.fed_back)
        sent.add_done_callback(errand.answered)
        assert errand.has_answer.wait(20), "no answer to the goal"
        return errand

    @property
    def off(self) -> float:
        """How far the last pose that was believed is from where the robot is, in m."""
        return self.believed[-1][0].distance(self.truth[-1]) if self.believed and self.truth else float("inf")


class Errand:
    """A goal that was sent."""

    def __init__(self) -> None:
        self.has_answer = threading.Event()
        self.accepted = False
        self.feedback: list[Any] = []
        self.status: int | None = None
        self.result: Any = None
        self._handle: Any = None

    def fed_back(self, message: Any) -> None:
        self.feedback.append(message.feedback)

    def answered(self, future: Any) -> None:
        self._handle = future.result()
        self.accepted = self._handle.accepted
        if self.accepted:
            self._handle.get_result_async().add_done_callback(self._resulted)
        self.has_answer.set()

    def _resulted(self, future: Any) -> None:
        answer = future.result()
        self.result, self.status = answer.result, answer.status

    def cancel(self) -> None:
        self._handle.cancel_goal_async()
