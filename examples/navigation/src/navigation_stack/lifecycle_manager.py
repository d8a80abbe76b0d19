"""lifecycle_manager: brings the nodes up in order and down again, as Nav2's does, where nobody else does it."""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav2_msgs.srv import ManageLifecycleNodes
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from navigation_stack.names import NODES

WITHIN = 10.0
"""s that a transition may take."""

_UP = {
    State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
}
_DOWN = {
    State.PRIMARY_STATE_ACTIVE: Transition.TRANSITION_DEACTIVATE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_CLEANUP,
}
_END = {
    State.PRIMARY_STATE_ACTIVE: Transition.TRANSITION_ACTIVE_SHUTDOWN,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_INACTIVE_SHUTDOWN,
    State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
}
_Command = ManageLifecycleNodes.Request
_COMMANDS: dict[int, tuple[dict[int, int], int, bool]] = {
    # how it goes on from each state, the state to get to, and whether in order
    _Command.STARTUP: (_UP, State.PRIMARY_STATE_ACTIVE, True),
    _Command.RESUME: (_UP, State.PRIMARY_STATE_ACTIVE, True),
    _Command.PAUSE: (_DOWN, State.PRIMARY_STATE_INACTIVE, False),
    _Command.RESET: (_DOWN, State.PRIMARY_STATE_UNCONFIGURED, False),
    _Command.SHUTDOWN: (_END, State.PRIMARY_STATE_FINALIZED, False),
}


class LifecycleManager(Node):
    """Serves ~/manage_nodes and ~/is_active. Parameters, named as Nav2's: node_names, autostart."""

    def __init__(self) -> None:
        super().__init__("lifecycle_manager_navigation")
        self._names: list[str] = self.declare_parameter("node_names", NODES).value
        self._one = threading.Lock()
        group = ReentrantCallbackGroup()  # it waits for answers while it answers
        self._change = {
            n: self.create_client(ChangeState, f"/{n}/change_state", callback_group=group) for n in self._names
        }
        self._get = {n: self.create_client(GetState, f"/{n}/get_state", callback_group=group) for n in self._names}
        self.create_service(ManageLifecycleNodes, "~/manage_nodes", self._managed, callback_group=group)
        self.create_service(Trigger, "~/is_active", self._answered, callback_group=group)
        if self.declare_parameter("autostart", os.environ.get("NAVIGATION_AUTOSTART", "") == "1").value:
            threading.Thread(target=self.manage, args=[_Command.STARTUP], daemon=True).start()

    def manage(self, command: int) -> bool:
        """Bring all nodes where a command wants them; whether they are there."""
        transitions, wanted, in_order = _COMMANDS[command]
        with self._one:
            for name in self._names if in_order else reversed(self._names):
                if not self._bring(name, transitions, wanted):
                    self.get_logger().error(f"{name}: not brought to state {wanted} within {WITHIN} s")
                    return False
        self.get_logger().info("Managed nodes are active" if in_order else "Managed nodes are down")
        return True

    def _managed(self, request: Any, response: Any) -> Any:
        response.success = request.command in _COMMANDS and self.manage(request.command)
        return response

    def _answered(self, request: Any, response: Any) -> Any:
        response.success = all(self._state(name, 1.0) == State.PRIMARY_STATE_ACTIVE for name in self._names)
        return response

    def _bring(self, name: str, transitions: dict[int, int], wanted: int) -> bool:
        end = time.monotonic() + WITHIN
        while time.monotonic() < end and rclpy.ok():
            state = self._state(name, 1.0)
            if state == wanted:
                return True
            if state in transitions:
                # The answer may be lost or late: the state shows the result.
                request = ChangeState.Request()
                request.transition.id = transitions[state]
                _call(self._change[name], request, 2.0)
            else:
                time.sleep(0.1)
        return False

    def _state(self, name: str, within: float) -> int | None:
        answer = _call(self._get[name], GetState.Request(), within)
        return None if answer is None else int(answer.current_state.id)


def _call(client: Any, request: Any, within: float) -> Any:
    """The answer, or None where none comes in time."""
    end = time.monotonic() + within
    while not client.service_is_ready():
        if time.monotonic() > end:
            return None
        time.sleep(0.05)
    done = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: done.set())
    if done.wait(within):
        return future.result()
    client.remove_pending_request(future)
    return None


def main() -> None:
    """Run until the process is asked to end."""
    rclpy.init()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(LifecycleManager())
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown(timeout_sec=1)
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
