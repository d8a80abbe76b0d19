"""The robots of a campaign: one for each way to recover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Way:
    """A way to recover, and the application that is recovered by it."""

    name: str
    strategy: str
    """The quickstart's manifest with policy and pool."""
    workload: str = "robotworkload.yaml"
    reflex: bool = False
    application: Literal["quickstart", "worker", "driver"] = "quickstart"
    """The quickstart's, or the one that counts steps and serves goals (``worker.py``), or the one in C (``driver.c``)."""

    @property
    def worker(self) -> bool:
        """Whether its application has steps and goals to lose."""
        return self.application == "worker"


WAYS = (
    Way("executing", "executing"),
    Way("reflex", "executing", reflex=True),
    Way("restart", "restart"),
    Way("uninitialized", "uninitialized", application="driver"),
    Way("initialized", "initialized", "managed/robotworkload.yaml"),
    Way("worker", "uninitialized", application="worker"),
)
BY_NAME = {way.name: way for way in WAYS}
