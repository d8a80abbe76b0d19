"""What a workload asks of its protection, in the paper's terms: by this the order of its strategies is chosen."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from understudy.api.base import Model

Level = Literal["Low", "Medium", "High"]


class Requirements(Model):
    """How much each of the paper's factors counts (section III, taxonomy). What each level means is in docs/choosing.md."""

    safety: Level = Field(
        default="Low",
        description="What must be known of the instance that takes over. Low: nothing more than is seen of every one before a recovery "
        "counts. Medium: one that is up already goes first (Initialized, Executing). High: one that was seen to be healthy while it "
        "waited goes first (Executing), whatever it costs.",
    )
    availability: Level = Field(
        default="Medium",
        description="How soon after its detection a failure is to be recovered from. Low: any time will do. Medium: 2 s. High: 500 ms.",
    )
    resource_usage: Level = Field(
        default="Medium",
        description="How much its standbys may take. Low: next to nothing (a tenth of a working instance's CPU). Medium: what it takes to "
        "recover soon enough, and no more. High: all that its pools offer.",
    )
    task_criticality: Level = Field(
        default="Low",
        description="How much is lost by an interruption of what the robot does. Low: nothing that availability doesn't say. Medium: as "
        "much as with availability Medium at least. High: as with availability High, and whatever it costs.",
    )
