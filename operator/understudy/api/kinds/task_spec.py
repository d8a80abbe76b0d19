"""Tasks of a workload: actions whose goals survive the instance that executes them."""

from __future__ import annotations

from typing import Literal

from understudy.api.base import Duration, Model, RosName, matching
from understudy.api.ros_names import ROS_TYPE_MESSAGE

ACTION_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/action/[A-Z][a-zA-Z0-9]*$"


class Task(Model):
    """An action that the workload serves. Clients send goals to a proxy of the same name, which survives every instance."""

    action: RosName
    """Fully qualified name of an action that the workload serves, such as /navigate_to_pose."""
    type: str = matching(ACTION_TYPE_PATTERN, ROS_TYPE_MESSAGE, max_length=256)
    """Type of the action, such as nav2_msgs/action/NavigateToPose. The monitor's image must contain it."""
    on_failover: Literal["Resend", "Abort", "Tree"] = "Resend"
    """What happens to an active goal when another instance takes over. Resend: the goal stays active and is sent to the
    new instance. Abort: the goal is aborted. Tree: the goal stays active, and the strategy's recovery procedure sends
    it (resend_goals)."""
    abort_grace: Duration = "2s"
    """How long the proxy delays an abort that no client requested. If a failure is detected meanwhile, the client does
    not receive the abort, because an instance that dies may abort its goals first."""


class TaskStatus(Model):
    """State of a task."""

    action: str
    """Name of the action."""
    active: int = 0
    """Number of active goals."""
    resent: int = 0
    """Number of goals that another instance took over, since the action proxy's pod started."""
    message: str = ""
    """What is wrong with the task, if anything."""
