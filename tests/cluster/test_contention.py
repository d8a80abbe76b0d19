"""Many clients at once on a real API server: whoever is first, no pod has two owners, no gate two pods, no pool too many.

The order of things is the API server's here; tests/unit/interleavings go through many more orders, of a model of it. Nothing is
trusted from what the contenders say: a watch of another client shows what happened in between.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.cluster.conftest import REPOSITORY, Release
from tests.cluster.contending import Outcome, contend
from tests.cluster.operators import CORE, NETWORK, Fleet, leader, policy, process, spare, template, workload
from tests.support.cluster import Cluster, Object, Refused, until
from tests.unit.monitor.gates import Packets
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.failover.interfaces import ClaimLost
from understudy.kube import claims
from understudy.kube.client import Access, Client
from understudy.kube.kubeconfig import load_access
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl as Instances
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

pytestmark = pytest.mark.alone  # the order of many clients is measured

END = "the-end"
"""The pod with which a watch of pods has told enough."""


@pytest.fixture
def fleet(cluster: Cluster, namespace: str, release: Release) -> Fleet:
    """A namespace that the installed operator, if there is one, doesn't look after."""
    return Fleet(cluster, namespace)


# -- what was so in between ---------------------------------------------------------------------------------------------


class History:
    """Every state of every pod of a namespace, in order."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.events: list[tuple[str, Object]] = []
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def _follow(self) -> None:
        for kind, pod in self._fleet.cluster.watch(CORE, "Pod", self._fleet.namespace):
            if pod["metadata"]["name"] == END:
                return
            self.events.append((kind, pod))

    def __enter__(self) -> History:
        before = {pod["metadata"]["uid"] for pod in self._fleet.pods("")}
        self._thread.start()
        until(lambda: before <= {pod["metadata"]["uid"] for _, pod in self.events}, "the watch to begin")
        return self

    def __exit__(self, *_: object) -> None:
        spec = template()["spec"]
        self._fleet.create({"apiVersion": CORE, "kind": "Pod", "metadata": {"name": END}, "spec": spec})
        self._thread.join(20)
        assert not self._thread.is_alive(), "the watch told nothing of the last pod"

    def claims(self) -> dict[str, str]:
        """By claim, the UID of the pod that ever had it. Fails where a pod had two, or two owners."""
        found: dict[str, str] = {}
        owners: dict[str, str] = {}
        for _, pod in self.events:
            metadata = pod["metadata"]
            if names.POOL not in (metadata.get("labels") or {}):
                continue
            controllers = [owner["uid"] for owner in metadata["ownerReferences"] if owner.get("controller")]
            assert len(controllers) == 1, f"{metadata['name']} has {len(controllers)} owners"
            claim = (metadata.get("annotations") or {}).get(names.CLAIM, "")
            (controller,) = controllers
            before = next((one for one, uid in found.items() if uid == metadata["uid"]), "")
            assert claim == before or not before, f"{metadata['name']} was claimed by {before}, then by {claim!r}"
            if claim:
                assert found.setdefault(claim, metadata["uid"]) == metadata["uid"], f"{claim} has two pods"
                assert owners.setdefault(metadata["uid"], controller) == controller, "a claimed pod has two owners"
                assert claim.startswith(f"{controller}/"), "who claimed it owns it"
                assert not claims.is_held(metadata["labels"]), "a claimed pod isn't free"
        return found

    def most_held(self) -> int:
        """The most free pods that there ever were at once."""
        held: set[str] = set()
        most = 0
        for kind, pod in self.events:
            metadata = pod["metadata"]
            free = claims.is_held(metadata.get("labels") or {})
            if free and kind != "DELETED" and "deletionTimestamp" not in metadata:
                held.add(metadata["uid"])
            else:
                held.discard(metadata["uid"])
            most = max(most, len(held))
        return most


@contextmanager
def kubelet(fleet: Fleet) -> Iterator[None]:
    """Reports the pods of the pool as ready, again and again, as kubelets do: their versions grow."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            for pod in fleet.pods(names.POOL):
                beat = {"type": "example.dev/beat", "status": "True", "message": str(time.time_ns())}
                conditions = [{"type": "Ready", "status": "True"}, beat]
                status = {"phase": "Running", "conditions": conditions, "containerStatuses": _running(pod)}
                with contextlib.suppress(Refused):  # it's gone
                    fleet.cluster.patch(pod, {"status": status}, subresource="status")

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(20)


def _running(pod: Object) -> list[Object]:
    """What a table of pods goes by."""
    common = {"image": "", "imageID": "", "ready": True, "restartCount": 0, "state": {"running": {}}}
    return [{"name": container["name"], **common} for container in pod["spec"]["containers"]]


# -- claims and gates ---------------------------------------------------------------------------------------------------

PODS = 12
ROBOTS = [f"robot-{number:02}" for number in range(18)]
SECOND = (ROBOTS[:6], ROBOTS[6:12])
"""Robots for which a process of its own contends too."""


def gate(robot: str) -> Object:
    """A closed gate, as the operator makes it."""
    return {
        "apiVersion": NETWORK,
        "kind": "NetworkPolicy",
        "metadata": {"name": names.gate(robot), "annotations": {names.EPOCH: "0"}},
        "spec": {
            "podSelector": {"matchLabels": {names.WORKLOAD: robot, names.INSTANCE: names.NOBODY}},
            "policyTypes": ["Egress"],
            "egress": [{}],
        },
    }


def held(fleet: Fleet, number: int) -> Object:
    """A free pod of the pool, as the operator makes it."""
    pool = fleet.get("FallbackPool", "spare")
    owner = {"apiVersion": API_VERSION, "kind": "FallbackPool", "name": "spare", "uid": pool["metadata"]["uid"]}
    metadata = {
        "name": f"spare-{number:02}",
        "labels": {
            names.POOL: "spare",
            names.HELD: "true",
            names.WORKLOAD: names.UNCLAIMED,
            names.CLAIMED_BY: names.UNCLAIMED,
        },
        "ownerReferences": [{**owner, "controller": True, "blockOwnerDeletion": False}],
    }
    return {"apiVersion": CORE, "kind": "Pod", "metadata": metadata, "spec": template()["spec"]}


class Elsewhere:
    """Contenders in processes of their own."""

    def __init__(self, fleet: Fleet) -> None:
        environment = {**os.environ, "PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'operator'}"}
        command = [sys.executable, "-m", "tests.cluster.contending", str(fleet.cluster.kubeconfig), fleet.namespace]
        self._processes = [
            subprocess.Popen(
                [*command, "spare", f"process-{number}", *robots],
                cwd=REPOSITORY,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for number, robots in enumerate(SECOND)
        ]

    def __enter__(self) -> Elsewhere:
        return self

    def __exit__(self, *_: object) -> None:
        for one in self._processes:
            one.kill()
            one.communicate()

    def begin(self) -> None:
        """Wait until all have read, and let them begin."""
        for one in self._processes:
            assert one.stdout is not None
            assert one.stdout.readline() == "ready\n", "a process ended before it began"
        for one in self._processes:
            assert one.stdin is not None
            one.stdin.write("\n")
            one.stdin.flush()

    def outcomes(self) -> list[Outcome]:
        """Wait for their results."""
        told = [one.communicate(timeout=30)[0] for one in self._processes]
        assert [one.returncode for one in self._processes] == [0] * len(self._processes)
        return [Outcome(**found) for text in told for found in json.loads(text)]


def test_every_pod_has_one_owner_and_every_gate_one_pod_in_any_order_of_claims(fleet: Fleet) -> None:
    fleet.create(spare(replicas=PODS), *(workload(robot) for robot in ROBOTS), *map(gate, ROBOTS))
    fleet.create(*(held(fleet, number) for number in range(PODS)))
    access = load_access(str(fleet.cluster.kubeconfig))
    with History(fleet) as history, kubelet(fleet), Elsewhere(fleet) as elsewhere:
        found = asyncio.run(contend(access, fleet.namespace, "spare", "here", ROBOTS, elsewhere.begin))
        found += elsewhere.outcomes()
    won = {outcome.claim: outcome.pod for outcome in found if outcome.pod}
    assert len(found) == len({outcome.claim for outcome in found}) == len(ROBOTS) + sum(map(len, SECOND))
    # What was won is in the API, and nothing else is.
    assert history.claims() == won
    assert _claimed(fleet) == won
    # Who lost one went on to the next: no pod is left, and who has none has tried all.
    assert set(won.values()) == {pod["metadata"]["uid"] for pod in fleet.pods(names.POOL)}
    assert len(won) == PODS
    for outcome in found:
        assert outcome.pod or len(outcome.lost) == PODS, f"{outcome.claim} has lost {len(outcome.lost)} only"
        assert outcome.pod not in outcome.lost
    # Of several that won a pod for the same robot, one has won its gate.
    for robot in ROBOTS:
        mine = [outcome for outcome in found if outcome.robot == robot and outcome.pod]
        opened = [outcome for outcome in mine if outcome.opened]
        assert len(opened) == min(1, len(mine))
        notes = fleet.gate(robot)["metadata"]["annotations"]
        assert notes[names.EPOCH] == str(len(opened))
        assert notes.get(names.ACTIVE_UID, "") == (opened[0].pod if opened else "")


def _claimed(fleet: Fleet) -> dict[str, str]:
    """By claim, the pods that have one now."""
    notes = {pod["metadata"]["uid"]: pod["metadata"].get("annotations") or {} for pod in fleet.pods(names.POOL)}
    return {found[names.CLAIM]: uid for uid, found in notes.items() if names.CLAIM in found}


# -- refilling ----------------------------------------------------------------------------------------------------------

SIZE = 3
DRIVEN = [f"driven-{number}" for number in range(4)]
CHURN = 6.0  # seconds


class Over(Exception):
    """Ends the watches of a robot."""


async def failing_again_and_again(
    access: Access, namespace: str, robot: str, uid: str, until: float, folder: Path
) -> dict[str, str]:
    """Take a pod of the pool, drive, and have failed a moment later, as the monitor's own code does it; by claim, the pods taken."""
    won: dict[str, str] = {}
    steps = CrashPoints(folder)
    try:
        async with Client(access) as client, asyncio.TaskGroup() as group:
            view = ClusterView(client, namespace, robot, Wakeups())
            await view.run(group)
            notices = Notices()
            instances = Instances(client, view, steps, notices)
            control = GateControl(client, view, instances, Packets({}), steps, notices)
            while time.monotonic() < until:
                await instances.refresh_unclaimed("spare")
                for candidate in instances.unclaimed("spare"):
                    with contextlib.suppress(ClaimLost):
                        claim = f"{uid}/{len(won)}"
                        taken = await instances.claim(candidate, claim)
                        won[claim] = taken.uid
                        failed = instances.find(control.state.active_uid)
                        await control.commit(taken, None)
                        if failed is not None:
                            await instances.retire(failed)
                        break
                await asyncio.sleep(random.uniform(0.01, 0.1))
            raise Over
    except* Over:
        pass
    return won


async def fail_together(
    fleet: Fleet, robots: Sequence[str], half: Callable[[], None], folder: Path
) -> list[dict[str, str]]:
    """Have all robots fail again and again; ``half`` is called in the midst of it."""
    access = load_access(str(fleet.cluster.kubeconfig))
    uids = [fleet.get("RobotWorkload", robot)["metadata"]["uid"] for robot in robots]
    end = time.monotonic() + CHURN
    asyncio.get_running_loop().call_later(CHURN / 2, half)
    return await asyncio.gather(
        *(
            failing_again_and_again(access, fleet.namespace, robot, uid, end, folder)
            for robot, uid in zip(robots, uids, strict=True)
        )
    )


def test_a_pool_that_many_take_from_is_refilled_and_never_overfilled(fleet: Fleet, tmp_path: Path) -> None:
    """Also while the leading operator is asked to end, and another one takes over."""
    multicast = {"discovery": {"mode": "Multicast"}}
    with ExitStack() as stack:
        operators = {identity: stack.enter_context(process(fleet, identity)) for identity in ("one", "two")}
        first = until(lambda: leader(fleet), "a leader")
        fleet.create(policy("spare", "Restart"), spare(replicas=SIZE))
        fleet.create(*(workload(robot, ros=multicast) for robot in DRIVEN))
        for robot in DRIVEN:
            fleet.wait_built(robot)
        until(lambda: len(fleet.held()) == SIZE, "the pool to be full")
        with History(fleet) as history, kubelet(fleet):
            end = lambda: operators[first].send_signal(signal.SIGTERM)  # noqa: E731
            found = asyncio.run(fail_together(fleet, DRIVEN, end, tmp_path))
            assert operators[first].wait(20) == 0
            until(lambda: leader(fleet) not in ("", first), "the other one to lead")
            until(lambda: len(fleet.held()) == SIZE, "the pool to be full again")
            fleet.cluster.delete(fleet.held()[0])
            until(lambda: len(fleet.held()) == SIZE, "the other one to fill it again")
        won = {claim: pod for one in found for claim, pod in one.items()}
        assert history.claims() == won
        assert history.most_held() == SIZE
        assert len(won) > 2 * SIZE, "it was refilled meanwhile"
        # Each drives with the last pod that it took; the others are gone.
        last = {list(one)[-1]: list(one.values())[-1] for one in found if one}
        assert _claimed(fleet) == last
        for robot, one in zip(DRIVEN, found, strict=True):
            notes = fleet.gate(robot)["metadata"]["annotations"]
            assert notes[names.EPOCH] == str(len(one))
            assert notes.get(names.ACTIVE_UID, "") == (list(one.values())[-1] if one else "")
