"""What is kept of a failure (the black box), and how the monitor tells of it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from understudy.api.base import DURATION_PATTERN, Duration, Model, matching, rules
from understudy.api.conditions import Time
from understudy.api.quantities import amount

SIZE_PATTERN = r"^[1-9][0-9]{0,3}(Mi|Gi)$"
SIZE_MESSAGE = "write a size with Mi or Gi, such as 64Mi"

Size = Annotated[str, Field(pattern=SIZE_PATTERN, max_length=6, json_schema_extra=matching(SIZE_PATTERN, SIZE_MESSAGE))]
"""An amount of bytes."""


class BlackBox(Model):
    """What is kept of each failure: what the monitor received before and during it, as an MCAP file."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                f"!self.window.matches(r'{DURATION_PATTERN}') || (duration(self.window) >= duration('1s') && "
                "duration(self.window) <= duration('10m'))",
                "window is from 1s to 10m",
                ".window",
            ),
        )
    }

    window: Duration = Field(default="30s", description="How much of the time before a failure is kept.")
    memory: Size = Field(
        default="16Mi",
        description="What the monitor may hold in memory for it. A topic that is too much for that, such as images, is left out, which "
        "the recordings and understudy blackbox say.",
    )
    max_recordings: int = Field(
        default=5, ge=1, le=100, description="How many recordings are kept of a workload; the oldest goes first."
    )
    max_size: Size = Field(
        default="64Mi",
        description="What the recordings of a workload may take on the disk together; the oldest goes first.",
    )

    @property
    def memory_bytes(self) -> int:
        """What the monitor may hold in memory."""
        return int(amount(self.memory))

    @property
    def most_bytes(self) -> int:
        """What the recordings may take on the disk."""
        return int(amount(self.max_size))


class Recording(Model):
    """One recording, as the monitor tells of it."""

    id: str = Field(description="Id of the recovery, as in status.recoveries.")
    number: int = Field(description="Number of the recovery.")
    failed: Time = Field(description="When the failure was detected.")
    reason: str = Field(description="What failed.")
    result: str = Field(description="Recovered or Failed.")
    strategy: str = Field(default="", description="The strategy that recovered it.")
    messages: int = Field(description="How many messages are in it.")
    left_out: dict[str, str] = Field(default_factory=dict, description="Topics that aren't in it, and why.")
    size: int = Field(description="Size of the file in bytes.")
    sha256: str = Field(description="SHA-256 of the file.")


class Recordings(Model):
    """What a monitor has kept, newest first."""

    workload: str = Field(description="The RobotWorkload.")
    on: bool = Field(description="Whether the policy asks for a black box.")
    left_out: dict[str, str] = Field(default_factory=dict, description="Topics that are left out at present, and why.")
    recordings: list[Recording] = Field(default_factory=list, description="The recordings.")
