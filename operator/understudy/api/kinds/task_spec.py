"""Tasks of a workload: actions whose goals outlive the instance that works on them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from understudy.api.base import Duration, Model, RosName, matching
from understudy.api.ros_names import ROS_TYPE_MESSAGE

ACTION_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/action/[A-Z][a-zA-Z0-9]*$"


class Task(Model):
    """An action that the workload serves. Clients talk to a proxy of the same name, which outlives every instance."""

    action: RosName = Field(description="Action that the workload serves, fully qualified, such as /navigate_to_pose.")
    type: str = Field(
        pattern=ACTION_TYPE_PATTERN,
        max_length=256,
        description="Type of the action, such as nav2_msgs/action/NavigateToPose. It must be installed in the monitor's image.",
        json_schema_extra=matching(ACTION_TYPE_PATTERN, ROS_TYPE_MESSAGE),
    )
    on_failover: Literal["Resend", "Abort", "Tree"] = Field(
        default="Resend",
        description="What becomes of a goal when another instance takes over. Resend: it stays active and is sent to the new "
        "instance. Abort: it is aborted. Tree: it stays active, and the strategy's recovery tree sends it (resend_goals).",
    )
    abort_grace: Duration = Field(
        default="2s",
        description="An abort that nobody asked for is told to the client this much later, and not at all if a failure is seen by "
        "then: an instance that dies may abort its goals first.",
    )


class TaskStatus(Model):
    """How a task is doing."""

    action: str = Field(description="The action.")
    active: int = Field(default=0, description="Goals that are active now.")
    resent: int = Field(
        default=0, description="Goals that another instance took over, since the task proxy is in its present pod."
    )
    message: str = Field(default="", description="What is wrong with it, if anything.")
