"""Two topics and a service behind one mux: a switch changes all of them at once, and nothing of a standby reaches the truck."""

from __future__ import annotations

import json
from itertools import groupby
from pathlib import Path

import pytest
import yaml

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import SIGNAL, Robot, eventually, never, patient

MANIFESTS = Path(__file__).parents[2] / "examples" / "forklift" / "manifests"
PERIODS = {"velocity": 1 / 25, "fork_height": 1 / 5, "beacon": 1.0}
"""Seconds between two messages or calls of one instance."""


class Forklift(Robot):
    """The truck, and what drives it."""

    def freeze(self, pod: str) -> None:
        """Stop the application's process in a pod."""
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", "STOP", "understudy_quickstart.forklift", container="drive")

    def received(self, since: float = 0.0) -> dict[str, list[Object]]:
        """Return what the truck received since a time, by the output's name."""
        script = "cat /var/log/robot/robot.jsonl"
        text = self.kubectl.shell(self.robot_pod(), "truck", script)
        found = [json.loads(line) for line in text.splitlines()]
        return {name: [one for one in found if one["event"] == name and one["received"] >= since] for name in PERIODS}


@pytest.mark.shows("output/topic", "output/service", "gate/Mux")
def test_a_switch_changes_both_topics_and_the_service_at_once(kubectl: Kubectl) -> None:
    for file in sorted(MANIFESTS.glob("*.yaml")):
        kubectl.apply(patient(list(yaml.safe_load_all(file.read_text()))))
    forklift = Forklift(kubectl, "forklift-1")
    first: str = eventually(
        lambda: forklift.condition("Protected").get("status") == "True" and forklift.status().get("active"),
        within=120,
        what="it is protected",
        note=forklift.describe,
    )
    eventually(lambda: all(forklift.received().values()), within=30, what="all three arrive", note=forklift.describe)
    forklift.freeze(first)
    recovery = forklift.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    after = recovery.moments["firstOutput"]
    eventually(
        lambda: len(forklift.received(after)["beacon"]) >= 5,
        within=30,
        what="the new instance calls",
        note=forklift.describe,
    )
    received = forklift.received()
    drivers = [source for source, _ in groupby(received["velocity"], key=lambda one: one["source"])]
    never([] if drivers == [first, recovery.new] else drivers, "commands of two instances in turn")
    for name, period in PERIODS.items():
        times = [one["received"] for one in received[name]]
        counted, spent = len(times), times[-1] - times[0]
        print(f"{name}: {counted} in {spent:.1f} s")
        assert counted <= spent / period + 2, f"{name} of one instance only"
