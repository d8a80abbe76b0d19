"""The chart, installed once, and a namespace for each test with everything in it removed afterwards."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
import uuid
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TypeVar

import pytest
import yaml

from tests.e2e.faults import ApiServer, Network, Stage, cluster, has_network_modes, staying
from tests.e2e.kubectl import Failed, Kubectl, helm
from tests.e2e.navigation import Navigator
from tests.e2e.observed_robot import ObservedRobot
from tests.e2e.scenario import Late, Robot, eventually, manifest, patient
from tests.support.reruns import once_more

R = TypeVar("R", bound=Robot)

SYSTEM = "understudy-system"
CHART = Path(__file__).parents[2] / "charts" / "understudy"
IMAGES = (
    "images.operator.repository=localhost/understudy-operator,images.operator.tag=dev,"
    "images.monitor.repository=localhost/understudy-monitor,images.monitor.tag=dev"
)

WIDE = ["--set", "allNamespaces=true", "--set-json", 'metrics.from=[{"ipBlock": {"cidr": "0.0.0.0/0"}}]']
"""Values for all namespaces, and for a Prometheus outside the cluster."""

NOT_AGAIN = ["^Never: "]
"""A test that fails is run once more, and said to have been: the machine is busy. What may never be at a robot is red at once."""


ALONE = {"api_server", "cordoned", "earlier", "network", "stage", "without_operator"}
"""Fixtures that change what all robots of a cluster share: its nodes, its API server, the operator."""


SELDOM, OFTEN = ("observed", "managed", "restarting", "uninitialized"), "executing"
"""Fixtures of robots that tests share. Few tests use most of them: these tests stay in one process. Each process has one of the last."""


ALWAYS_BOTH_KINDS = {
    "test_fence",
    "test_limits",
    "test_reflex",
    "test_safety",
    "test_strategies",
    "test_switchover",
    "test_tasks",
}
"""Modules whose tests run with both kinds of gates in CI too; elsewhere, those with a mux are `long`."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrize the gate's kind. A test that is marked ``network_policy`` is about packets, or about the robot's own readers."""
    only = metafunc.definition.get_closest_marker("network_policy")
    if "gate_kind" in metafunc.fixturenames and only is None:
        module = metafunc.module.__name__.rpartition(".")[2]
        marks = () if module in ALWAYS_BOTH_KINDS else (pytest.mark.long,)
        metafunc.parametrize("gate_kind", ["NetworkPolicy", pytest.param("Mux", marks=marks)])


@pytest.fixture
def gate_kind() -> str:
    """``spec.gate.kind`` of the test's workloads."""
    return "NetworkPolicy"


def _kind(item: pytest.Item) -> str:
    params: dict[str, object] = getattr(getattr(item, "callspec", None), "params", {})
    return str(params.get("gate_kind", "NetworkPolicy"))


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    mine = [item for item in items if "tests/e2e" in str(item.path)]
    for item in mine:
        item.add_marker(pytest.mark.timeout(900))
        item.add_marker(once_more(config, rerun_except=NOT_AGAIN))
        if ALONE & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.alone)
        if (robot := _shared(item)) in SELDOM:
            item.add_marker(pytest.mark.xdist_group(f"{robot} {_kind(item)}"))
    # Tests that share a robot come last: they are short, so that all processes end together. Until then, none of these robots runs.
    shared = {item: _shared(item) for item in mine}
    order = ("", *SELDOM, OFTEN)
    items.sort(key=lambda item: (order.index(robot := shared.get(item, "")), _kind(item) if robot else ""))


def _shared(item: pytest.Item) -> str:
    """The fixture of the robot that the test shares with others; empty where it has its own, or none."""
    if item.get_closest_marker("alone") or item.get_closest_marker("own_robot"):
        return ""
    return next((name for name in (*SELDOM, OFTEN) if name in getattr(item, "fixturenames", ())), "")


FAILED = pytest.StashKey[bool]()
"""Whether the test has failed, so that nobody else gets its robot."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    item.stash[FAILED] = report.failed
    return report


def install(kubeconfig: Path, chart: Path = CHART, *arguments: str, images: str = "") -> Kubectl:
    """Install by the chart (with more arguments of helm, such as values), in a namespace at Pod Security `restricted`.

    Answers with kubectl in the operator's namespace. The pods are new, since the images may be, under one tag.

    Args:
        images: values that name other images than those under test.
    """
    system = Kubectl(kubeconfig, SYSTEM)
    restricted = {"pod-security.kubernetes.io/enforce": "restricted"}
    system.apply([{"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": SYSTEM, "labels": restricted}}])
    values = images or os.environ.get("UNDERSTUDY_HELM_SET", IMAGES)
    # The chart of an earlier version watches all namespaces, and refuses a value that it does not know.
    wide = "allNamespaces" in yaml.safe_load((chart / "values.yaml").read_text())
    rolled = f"operator.podAnnotations.rolled-out={time.time():.0f}"
    helm(
        kubeconfig, "upgrade", "--install", "understudy", str(chart), "--namespace", SYSTEM,
        *arguments, "--set", values, *(WIDE if wide else []), "--set-string", rolled, "--wait", "--timeout", "180s",
    )  # fmt: skip
    return system


@pytest.fixture(scope="session")
def release(kubeconfig: Path) -> Kubectl:
    """kubectl in the namespace of the operator, which was installed by the chart and through nothing else.

    The first of several processes that run side by side installs it.
    """
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    if run is None:
        return install(kubeconfig)
    with (Path(tempfile.gettempdir()) / f"understudy-e2e-{run}").open("a") as installed:
        fcntl.flock(installed, fcntl.LOCK_EX)
        if installed.tell() == 0:
            install(kubeconfig)
            installed.write("installed\n")
    return Kubectl(kubeconfig, SYSTEM)


@pytest.fixture(scope="session")
def namespaces(release: Kubectl) -> Iterator[list[str]]:
    """The namespaces of all tests. They end while the next test begins, and none may be left when all are through."""
    made: list[str] = []
    yield made
    if not os.environ.get("UNDERSTUDY_KEEP"):
        eventually(
            lambda: not {n["metadata"]["name"] for n in release.list("namespaces")} & set(made),
            within=150, what="the namespaces of all tests are gone", note=lambda: release("get", "namespaces"),
        )  # fmt: skip


@pytest.fixture
def kubectl(release: Kubectl, namespaces: list[str]) -> Iterator[Kubectl]:
    """kubectl in a namespace of the test's own."""
    mine = _namespace(release, namespaces)
    yield mine
    _leave(mine)


def _namespace(release: Kubectl, namespaces: list[str]) -> Kubectl:
    name = f"e2e-{uuid.uuid4().hex[:6]}"
    namespaces.append(name)
    release("create", "namespace", name)
    return release.in_namespace(name)


def _leave(kubectl: Kubectl) -> None:
    """Let a namespace end, while whatever comes next begins."""
    if not os.environ.get("UNDERSTUDY_KEEP"):
        kubectl("delete", "namespace", kubectl.namespace, "--wait=false", "--ignore-not-found")


@pytest.fixture(scope="session")
def shared(release: Kubectl, namespaces: list[str]) -> Iterator[dict[str, Robot]]:
    """The robot that tests use one after the other, by strategy."""
    robots: dict[str, Robot] = {}
    yield robots
    for robot in robots.values():
        _leave(robot.kubectl)


@pytest.fixture(scope="module")
def ends_with_file(shared: dict[str, Robot]) -> Iterator[None]:
    """The robots that tests of a file share end with the file, because they need much of the machine."""
    yield
    while shared:
        _leave(shared.popitem()[1].kubectl)


@pytest.fixture
def executing(request: pytest.FixtureRequest, gate_kind: str) -> Robot:
    """A robot whose application has an executing standby."""
    return _robot(request, "executing", gate_kind)


@pytest.fixture
def uninitialized(request: pytest.FixtureRequest, gate_kind: str) -> Robot:
    """A robot whose application is protected by a pool of held pods."""
    return _robot(request, "uninitialized", gate_kind)


@pytest.fixture
def restarting(request: pytest.FixtureRequest, gate_kind: str) -> Robot:
    """A robot whose application is only restarted."""
    return _robot(request, "restart", gate_kind)


@pytest.fixture
def managed(request: pytest.FixtureRequest, gate_kind: str) -> Robot:
    """A robot whose application is a managed node, with a standby that waits configured."""
    return _robot(request, "initialized", gate_kind, workload="managed/robotworkload.yaml")


def _robot(request: pytest.FixtureRequest, strategy: str, kind: str, workload: str = "robotworkload.yaml") -> Robot:
    """The test's own robot, or the one that tests share."""
    if not _shared(request.node):
        return _started(request.getfixturevalue("kubectl"), strategy, kind, workload)
    return _lent(request, f"{strategy} {kind}", lambda kubectl: _started(kubectl, strategy, kind, workload))


@pytest.fixture
def navigator(request: pytest.FixtureRequest) -> Navigator:
    """A mobile robot with an executing standby of its navigation stack, which tests share."""

    def started(kubectl: Kubectl) -> Navigator:
        robot = Navigator(kubectl)
        robot.set_up("executing")
        robot.wait_protected(within=240)
        return robot

    return _lent(request, "navigator", started)


@pytest.fixture
def observed(request: pytest.FixtureRequest) -> ObservedRobot:
    """A robot with the trees of the language that is the fixture's parameter, with an executing standby, which tests share."""
    language: str = request.param

    def started(kubectl: Kubectl) -> ObservedRobot:
        robot = ObservedRobot(kubectl)
        kubectl.apply(robot.observed(language))
        robot.wait_protected()
        return robot

    return _lent(request, f"observed {language}", started)


def _lent(request: pytest.FixtureRequest, name: str, start: Callable[[Kubectl], R]) -> R:
    """The robot that tests share, as long as that one is well. Only one that is shared runs at a time."""
    robots: dict[str, R] = request.getfixturevalue("shared")
    robot = robots.pop(name, None)
    while robots:
        _leave(robots.popitem()[1].kubectl)
    if robot is not None:
        try:
            robot.wait_protected(within=30)
        except Late:
            _leave(robot.kubectl)
            robot = None
    if robot is None:
        robot = start(_namespace(request.getfixturevalue("release"), request.getfixturevalue("namespaces")))
    lent = robot
    lent.begin()

    def end() -> None:
        if request.node.stash[FAILED]:
            _leave(lent.kubectl)
        else:
            robots[name] = lent

    request.addfinalizer(end)
    return lent


def _started(kubectl: Kubectl, strategy: str, kind: str, workload: str) -> Robot:
    robot = Robot(kubectl, gate_kind=kind)
    kubectl.apply(manifest(f"strategies/{strategy}.yaml"))
    kubectl.apply(robot.objects(policy=f"quickstart-{strategy}", workload=workload))
    robot.wait_protected()
    return robot


@pytest.fixture
def stage(kubectl: Kubectl) -> Iterator[Stage]:
    """Nodes that can be lost; whole again when the test has ended."""
    if Path(cluster("kubeconfig").strip()) != kubectl.kubeconfig:
        pytest.skip("the cluster under test isn't the one whose nodes scripts/cluster can take away")
    found = Stage(kubectl)
    yield found
    found.clear()


@pytest.fixture
def network(kubectl: Kubectl) -> Iterator[Network]:
    """The networks of the nodes, which are as they should be when the test has ended."""
    if Path(cluster("kubeconfig").strip()) != kubectl.kubeconfig:
        pytest.skip("the cluster under test isn't the one whose network scripts/cluster can weaken")
    if not has_network_modes():
        pytest.skip("only the provider's own enforcer can be weakened")
    found = Network()
    yield found
    found.restore()


@pytest.fixture
def apart(kubectl: Kubectl, stage: Stage, gate_kind: str) -> Robot:
    """A robot with an executing standby, the two of them on nodes of their own."""
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    objects = staying(robot.objects(policy="quickstart-executing"))
    stage.place(objects)
    kubectl.apply(objects)
    active = robot.wait_protected()
    others = [pod["metadata"]["name"] for pod in robot.pods() if pod["metadata"]["name"] != active]
    assert stage.node_of(active) not in {stage.node_of(other) for other in others}, "understudies are kept apart"
    return robot


@pytest.fixture
def without_operator(release: Kubectl) -> Iterator[None]:
    """The operator scaled to nothing for as long as the test uses this; call it after the robot is protected."""
    release("scale", "deployment", "understudy-operator", "--replicas=0")
    eventually(
        lambda: not release.list("pods", "app.kubernetes.io/name=understudy"), within=60, what="no operator is left"
    )
    yield
    release("scale", "deployment", "understudy-operator", "--replicas=2")
    try:
        release("rollout", "status", "deployment/understudy-operator", "--timeout=60s", timeout=70)
    except Failed as error:
        pytest.fail(str(error))


@pytest.fixture
def api_server(kubectl: Kubectl) -> Iterator[ApiServer]:
    """The API server, which runs again when the test has ended."""
    if Path(cluster("kubeconfig").strip()) != kubectl.kubeconfig:
        pytest.skip("the cluster under test isn't the one that scripts/cluster stops the API server of")
    server = ApiServer(kubectl)
    yield server
    if server.stopped:
        server.start()
