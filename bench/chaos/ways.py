"""The robots of a campaign: one for each way to recover."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Way:
    """A way to recover, and the application that is recovered by it."""

    name: str
    strategy: str
    """The quickstart's manifest with policy and pool."""
    workload: str = "robotworkload.yaml"
    reflex: bool = False
    worker: bool = False
    """Whether the application is the one that counts steps and serves goals, instead of the quickstart's."""


WAYS = (
    Way("executing", "executing"),
    Way("reflex", "executing", reflex=True),
    Way("restart", "restart"),
    Way("uninitialized", "uninitialized"),
    Way("initialized", "initialized", "managed/robotworkload.yaml"),
    Way("worker", "uninitialized", worker=True),
)
"""All examples have applications in Python: there is no image with one in C++."""

BY_NAME = {way.name: way for way in WAYS}
