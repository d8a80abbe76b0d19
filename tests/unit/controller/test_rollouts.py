"""New monitors come to a fleet in steps: while its monitor is replaced, nobody watches a robot."""

from __future__ import annotations

import pytest

from tests.unit.controller import world
from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Apply, Write
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.rollouts import CHECK_PERIOD, HOLD, Rollouts
from understudy.controller.runtime.process import options
from understudy.kube import apply
from understudy.kube.client import CONFIG_MAPS, DEPLOYMENTS, PODS, WORKLOADS, Object

VERSIONS = iter(range(1000, 1_000_000))


def key(number: int) -> Key:
    return Key(WORKLOADS.plural, world.NAMESPACE, f"w-{number}")


class Fleet:
    """Robots with a monitor and a discovery server each, which are replaced as Kubernetes replaces them."""

    def __init__(self, robots: int, *, percent: int = 10) -> None:
        self.store, self.now = Store(), 0.0
        self.rollouts = Rollouts(self.store, percent=percent, clock=lambda: self.now)
        self.robots = range(robots)
        for number in self.robots:
            self.store.put(WORKLOADS, world.workload(f"w-{number}"))
            for name in self.deployments(number):
                self.put(DEPLOYMENTS, apply.stamped(self.deployment(name, "1")))
                self.pod(number, name, "1")

    @staticmethod
    def deployments(number: int) -> list[str]:
        return [names.monitor(f"w-{number}"), names.discovery(f"w-{number}")]

    @staticmethod
    def deployment(name: str, image: str, **labels: str) -> Object:
        template = {"spec": {"containers": [{"name": "one", "image": image}]}}
        metadata = {"name": name, "namespace": world.NAMESPACE, "uid": f"uid-{name}", "labels": labels}
        return {"metadata": metadata, "spec": {"template": template}}

    def put(self, resource: object, item: Object) -> None:
        item["metadata"]["resourceVersion"] = str(next(VERSIONS))
        self.store.put(resource, item)  # type: ignore[arg-type]

    def pod(self, number: int, deployment: str, image: str, *, ready: bool = True) -> None:
        metadata = {
            "name": f"{deployment}-{image}", "namespace": world.NAMESPACE, "uid": f"{deployment}-{image}",
            "labels": {names.MONITORED: f"w-{number}"},
        }  # fmt: skip
        conditions = [{"type": "Ready", "status": "True" if ready else "False"}]
        self.put(PODS, {"metadata": metadata, "status": {"phase": "Running", "conditions": conditions}})

    def replaced(self, number: int, image: str, *, ready: bool = True) -> None:
        """The pods of a robot's Deployments are others now."""
        for pod in self.store.labelled(PODS, world.NAMESPACE, names.MONITORED, f"w-{number}"):
            self.store.remove(PODS, {**pod, "metadata": {**pod["metadata"], "resourceVersion": str(next(VERSIONS))}})
        for name in self.deployments(number):
            self.put(DEPLOYMENTS, apply.stamped(self.deployment(name, image)))
            self.pod(number, name, image, ready=ready)

    def asks(self, number: int, image: str = "2") -> tuple[int, float | None]:
        """How many of a robot's two Deployments may be written, and when it looks again."""
        settings: Object = {"metadata": {"name": "settings"}}
        writes: list[Write] = [Apply(DEPLOYMENTS, self.deployment(name, image)) for name in self.deployments(number)]
        admitted, again = self.rollouts.admitted(key(number), [Apply(CONFIG_MAPS, settings), *writes])
        assert any(kube_objects.name(write.body) == "settings" for write in admitted if isinstance(write, Apply))
        return len(admitted) - 1, again


def counted(state: str) -> float | None:
    return operator_metrics.REGISTRY.get_sample_value("understudy_monitor_rollouts", {"state": state})


def test_a_tenth_of_the_monitors_is_replaced_at_once_and_ready_ones_make_room_for_others() -> None:
    fleet = Fleet(20)
    assert [fleet.asks(number)[0] for number in fleet.robots] == [2, 2, *[0] * 18]
    assert fleet.asks(0) == (2, None), "whoever has begun goes on"
    fleet.replaced(0, "2", ready=False)
    assert fleet.asks(5)[0] == 0, "not ready yet"
    fleet.replaced(0, "2")
    assert fleet.asks(0) == (2, None), "there is nothing left to be replaced"
    assert fleet.asks(5) == (2, None)
    assert fleet.asks(6)[0] == 0
    assert [counted(state) for state in ("under_way", "waiting")] == [2, 17]
    for number in fleet.robots:
        fleet.asks(number)
        fleet.replaced(number, "2")
        fleet.asks(number)
    assert [counted(state) for state in ("under_way", "waiting")] == [0, 0], "nothing is left to be done"


def test_the_monitors_of_a_small_fleet_are_replaced_one_after_another() -> None:
    fleet = Fleet(3)
    assert [fleet.asks(number)[0] for number in fleet.robots] == [2, 0, 0]


def test_a_workload_later_in_the_queue_checks_again_later() -> None:
    fleet = Fleet(20)
    again = [fleet.asks(number)[1] for number in fleet.robots]
    assert again[:6] == [None, None, CHECK_PERIOD, CHECK_PERIOD, 2 * CHECK_PERIOD, 2 * CHECK_PERIOD]
    assert again[-1] == 9 * CHECK_PERIOD


def test_a_monitor_that_is_not_ready_is_replaced_at_once() -> None:
    """A version whose monitors don't come up is mended by the next one, however many places it has taken."""
    fleet = Fleet(20)
    for number in (0, 1):
        fleet.asks(number)
        fleet.replaced(number, "2", ready=False)
    assert fleet.asks(0, "3") == (2, None)
    fleet.replaced(7, "1", ready=False)
    assert fleet.asks(7) == (2, None)
    assert fleet.asks(8)[0] == 0


def test_a_monitor_that_does_not_become_ready_delays_the_others_for_a_bounded_time() -> None:
    fleet = Fleet(2)
    fleet.asks(0)
    fleet.replaced(0, "2", ready=False)
    fleet.now = HOLD - 1
    assert fleet.asks(1)[0] == 0
    fleet.now = HOLD
    assert fleet.asks(1) == (2, None)


def test_a_deleted_workload_delays_no_other() -> None:
    fleet = Fleet(3)
    fleet.asks(0)
    assert fleet.asks(1)[0] == 0
    fleet.rollouts.forget(key(0))
    assert fleet.asks(1)[0] == 2


def test_new_and_unchanged_monitors_do_not_wait() -> None:
    fleet = Fleet(2)
    fleet.asks(0)
    assert fleet.asks(1, "1") == (2, None)
    name = names.monitor("w-1")
    relabelled: list[Write] = [Apply(DEPLOYMENTS, fleet.deployment(name, "1", since="now"))]
    assert fleet.rollouts.admitted(key(1), relabelled) == (relabelled, None), "no pod is replaced by it"
    first: list[Write] = [Apply(DEPLOYMENTS, fleet.deployment("w-9-monitor", "1"))]
    assert fleet.rollouts.admitted(key(9), first) == (first, None)


def test_the_share_is_an_option_of_the_operator(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor")
    assert options([])[1].rollout_percent == 10
    monkeypatch.setenv("UNDERSTUDY_ROLLOUT_PERCENT", "25")
    assert options([])[1].rollout_percent == 25
    fleet = Fleet(4, percent=50)
    assert [fleet.asks(number)[0] for number in fleet.robots] == [2, 2, 0, 0]
    with pytest.raises(SystemExit):
        options(["--rollout-percent", "0"])
    assert "'0' is not a whole number from 1 to 100" in capsys.readouterr().err
