"""The monitors of scripts/bench scale can use their simulated senses as monitors use the real ones."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import pytest

from bench.scaling import senses as simulated
from tests.unit.interleavings import senses as model
from understudy.kube.gates.base import Proof
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.robot.health_observer import GatedReaders, HealthObserver


def parameters(kind: type) -> Mapping[str, list[str]]:
    """The parameters of each public method."""
    found = inspect.getmembers(kind, inspect.isfunction)
    return {name: list(inspect.signature(method).parameters) for name, method in found if not name.startswith("_")}


@pytest.mark.parametrize(
    ("kind", "real"),
    [
        ("HealthObserver", HealthObserver),
        ("Outputs", GatedReaders),
        ("Probes", Proof),
        ("AgentConnections", AgentConnections),
    ],
)
def test_a_simulated_sense_has_the_methods_that_a_monitor_calls(kind: str, real: type) -> None:
    """What the interleaving model needs of a sense, a monitor calls: the model's monitors are real too."""
    found, wanted = parameters(getattr(simulated, kind)), parameters(real)
    called = parameters(getattr(model, kind)).keys() & wanted.keys()
    assert called <= found.keys()
    assert {name: found[name] for name in called} == {name: wanted[name] for name in called}
