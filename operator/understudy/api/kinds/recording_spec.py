"""Recordings of failures (the black box), and how the monitor lists them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from understudy.api.base import Duration, Model, ReportedText, length, matching, with_rules
from understudy.api.conditions import Time
from understudy.api.quantities import amount

SIZE_PATTERN = r"^[1-9][0-9]{0,3}(Mi|Gi)$"
SIZE_MESSAGE = "write a size with Mi or Gi, such as 64Mi"

Size = Annotated[str, matching(SIZE_PATTERN, SIZE_MESSAGE, max_length=6)]
"""A number of bytes."""


@with_rules(length("window", "1s", "10m"))
class BlackBox(Model):
    """Recording of each failure: what the monitor received before and during it, as an MCAP file."""

    window: Duration = "30s"
    """Length of the recorded time before the detection of a failure. The recording ends 2 s after the recovery."""
    memory: Size = "16Mi"
    """Memory that the monitor may use for recent messages. Topics that need more, such as images, are left out. The
    recording and `understudy blackbox` list these topics."""
    max_recordings: int = Field(default=5, ge=1, le=100)
    """Maximum number of recordings of a workload. The oldest is deleted first."""
    max_size: Size = "64Mi"
    """Maximum disk space of a workload's recordings. The oldest recording is deleted first."""

    @property
    def memory_bytes(self) -> int:
        """Memory limit in bytes."""
        return int(amount(self.memory))

    @property
    def most_bytes(self) -> int:
        """Disk limit in bytes."""
        return int(amount(self.max_size))


class Recording(Model):
    """One recording, as the monitor lists it."""

    id: str
    """Id of the recovery, as in status.recoveries."""
    number: int
    """Number of the recovery."""
    failed: Time
    """When the failure was detected."""
    reason: ReportedText
    """What failed."""
    result: str
    """Recovered or Failed."""
    strategy: str = ""
    """The strategy that recovered it."""
    messages: int
    """Number of messages in the recording."""
    left_out: dict[str, str] = Field(default_factory=dict)
    """Topics that were left out, and why."""
    size: int
    """Size of the file in bytes."""
    sha256: str
    """SHA-256 of the file."""


class Recordings(Model):
    """The recordings that a monitor has, newest first."""

    workload: str
    """The RobotWorkload."""
    on: bool
    """Whether the policy asks for recordings."""
    left_out: dict[str, str] = Field(default_factory=dict)
    """Topics that are currently left out, and why."""
    recordings: list[Recording] = Field(default_factory=list)
    """The recordings."""
