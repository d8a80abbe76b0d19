"""Goal ledgers for tests."""

from __future__ import annotations

import pytest

from tests.unit.action_proxy.world import World


@pytest.fixture
def world() -> World:
    made = World()
    made.switch("a")
    return made


def status(world: World, goal: str) -> int:
    return world.ledger.goals[goal].status
