"""Tasks of a workload: actions whose goals survive the instance that executes them."""

from __future__ import annotations

from typing import Literal

from understudy.api.base import Duration, Model, ReportedText, RosName, matching
from understudy.api.ros_names import ROS_TYPE_MESSAGE

ACTION_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/action/[A-Z][a-zA-Z0-9]*$"


class Task(Model):
    """An action that the workload serves. Clients send their goals to a proxy with the same action name."""

    action: RosName
    """Fully qualified name of an action that the workload serves, such as /navigate_to_pose. Its proxy runs in a
    container of the monitor's pod, so the proxy keeps running if an instance fails."""
    type: str = matching(ACTION_TYPE_PATTERN, ROS_TYPE_MESSAGE, max_length=256)
    """Type of the action, such as nav2_msgs/action/NavigateToPose. The monitor's image must contain it."""
    on_failover: Literal["Resend", "Abort", "Tree"] = "Resend"
    """What happens to an active goal when another instance takes over. Resend: the goal stays active and is sent to the
    new instance. Abort: the goal is aborted. Tree: the goal stays active and is sent to the new instance by the step
    resend_goals of the strategy's recovery procedure, or at the end of the recovery."""
    abort_grace: Duration = "2s"
    """If the instance aborts a goal, or ends it as canceled although no client requested that, the proxy waits this
    long before it reports the result to the client, because a failing instance may end its goals. If a failure is
    detected in this time, the proxy drops the result, and treats the goal as active (onFailover)."""


class TaskStatus(Model):
    """State of a task."""

    action: str
    """Name of the action."""
    active: int = 0
    """Number of active goals."""
    resent: int = 0
    """Number of goals that were moved to another instance since the monitor's pod started."""
    message: ReportedText = ""
    """What is wrong with the task, if anything."""
