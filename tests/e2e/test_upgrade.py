"""An upgrade from the version before this one, and the way back (docs/how-to/production.md). What is upgraded is all that version's own:
chart, definitions, operator, monitors, and the agents in the pods, of which those in control go on driving.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from testcluster.images import commits
from tests.e2e.conftest import IMAGES, SYSTEM, install
from tests.e2e.console import understudy
from tests.e2e.kubectl import Kubectl, Object, helm
from tests.e2e.scenario import Robot, eventually, manifest, patient
from tests.e2e.test_production import LONGEST, start, starting
from tests.e2e.test_strategies import assert_handed_over
from tests.support.cluster import account
from tests.support.rights import listed, named
from understudy import __version__
from understudy.api import names
from understudy.kube import claims

EARLIER, EARLIER_VERSION = "059171a5435c2acd51b84946c11afc81124e2f52", "0.1.0"
"""The commit of the version before this one. With each new version, the last commit of the one that was."""

OURS = ("localhost/understudy-operator:", "localhost/understudy-monitor:")
"""Images of Understudy's own; the quickstart's application isn't one of them and stays as it is."""

PRESENT = "dev"

OPERATORS = "app.kubernetes.io/name=understudy,app.kubernetes.io/component=operator"

EXECUTING, UNINITIALIZED = "quickstart-executing", "quickstart-uninitialized"


@dataclass(frozen=True)
class Version:
    """A version of Understudy that can be installed: its chart, and the tag of its images, which are on the nodes."""

    chart: Path
    tag: str


@pytest.fixture(scope="module")
def earlier_version(release: Kubectl, pytestconfig: pytest.Config) -> Version:
    """The version before this one, built from its commit as scripts/images builds the present one."""
    if "UNDERSTUDY_HELM_SET" in os.environ:
        pytest.skip("the images under test were brought to the cluster by other means than scripts/images")
    try:
        source = commits.lay_out(EARLIER)
    except commits.NoSuchCommit as error:
        pytest.skip(str(error))
    provider: str | None = pytestconfig.getoption("cluster")
    program = Path(__file__).parents[2] / "scripts" / "images"
    command = [str(program), "--commit", EARLIER, "--load", "operator", "monitor"]
    done = subprocess.run(
        [*command, *(["--provider", provider] if provider else [])], capture_output=True, text=True, timeout=800
    )
    assert done.returncode == 0, done.stderr
    return Version(source.folder / "charts" / "understudy", source.tag)


@pytest.fixture
def earlier(release: Kubectl, earlier_version: Version) -> Iterator[Version]:
    """The version before this one is what is installed; afterwards it's this one again, whatever happened."""
    helm(release.kubeconfig, "uninstall", "understudy", "--namespace", SYSTEM, "--wait", "--timeout", "120s")
    install(release.kubeconfig, earlier_version.chart, images=IMAGES.replace("tag=dev", f"tag={earlier_version.tag}"))
    yield earlier_version
    install(release.kubeconfig)


def tags(pod_template: Object) -> set[str]:
    """The tags of Understudy's own images in a pod or a template."""
    spec = pod_template["spec"]
    images = [container["image"] for container in [*spec.get("initContainers", []), *spec["containers"]]]
    return {image.rpartition(":")[2] for image in images if image.startswith(OURS)}


def living(pods: list[Object]) -> list[Object]:
    """Those that nobody has deleted."""
    return [pod for pod in pods if not pod["metadata"].get("deletionTimestamp")]


def ready(pod: Object) -> bool:
    return any((c["type"], c["status"]) == ("Ready", "True") for c in pod["status"].get("conditions") or [])


def version(kubectl: Kubectl, pod: Object) -> str:
    """Of the package that a pod runs."""
    script = "import understudy; print(understudy.__version__)"
    return kubectl("exec", pod["metadata"]["name"], "--", "python", "-c", script).strip()


def held(kubectl: Kubectl) -> list[Object]:
    """The pods of the pool that belong to nobody yet."""
    return living(
        [pod for pod in kubectl.list("pods", f"{names.HELD}=true") if claims.is_held(pod["metadata"]["labels"])]
    )


def operators(release: Kubectl) -> list[Object]:
    return living(release.list("pods", OPERATORS))


def around(robot: Robot) -> list[Object]:
    """The Deployments of its monitor and of its discovery server."""
    return robot.kubectl.list("deployments", f"{names.MONITORED}={robot.workload}")


def standbys(robot: Robot, active: str) -> list[Object]:
    """Its pods beside the one in control."""
    return [pod for pod in living(robot.pods()) if pod["metadata"]["name"] != active]


def definition(release: Kubectl) -> str:
    return json.dumps(release.get("crd", "robotworkloads.understudy.dev"))


BEFORE = 10.0
"""Seconds before the upgrade that are looked at too: what is usual on a machine that is busy with other things."""

STANDING = {"app": "standing"}
"""Labels of the robot with a standby. A pool for each workload serves all that it selects, so it selects nobody else."""


def strategies() -> list[Object]:
    """The policies and the pools of both robots. A gap is looked for at the robots, and isn't to be filled by a recovery."""
    found = manifest("strategies/executing.yaml") + manifest("strategies/uninitialized.yaml")
    for item in found:
        if (item["kind"], item["metadata"]["name"]) == ("FallbackPool", EXECUTING):
            item["spec"]["workloadSelector"] = {"matchLabels": STANDING}
    return patient(found)


def driven(kubectl: Kubectl) -> tuple[Robot, Robot, dict[Robot, str]]:
    """A robot with a pod of the pool and one with a standby, both protected; and the pod in control of each."""
    pooled, standing = Robot(kubectl, "robot-1"), Robot(kubectl, "robot-2")
    kubectl.apply(
        strategies() + pooled.objects(policy=UNINITIALIZED) + standing.objects(policy=EXECUTING, labels=STANDING)
    )
    return pooled, standing, {robot: robot.wait_protected() for robot in (pooled, standing)}


def all_around(robots: dict[Robot, str], active: dict[Robot, str], tag: str) -> bool:
    """Whether monitors, discovery servers, standbys and the pool are those of a version, and ready.

    Args:
        robots: with the policy of each.
        active: the pod in control of each, which may be of any version.
    """
    rolled = [d for robot in robots for d in around(robot) if tags(d["spec"]["template"]) == {tag}]
    done = [d for d in rolled if d["status"].get("readyReplicas") == d["status"].get("updatedReplicas") == 1]
    [standing] = [robot for robot, policy in robots.items() if policy == EXECUTING]
    there, free = standbys(standing, active[standing]), held(standing.kubectl)
    return (
        len(done) == 2 * len(robots)
        and bool(there and free)
        and all(tags(p) == {tag} and ready(p) for p in there + free)
    )


def lose(robot: Robot, active: str, policy: str, *, number: int, expires: bool = True) -> str:
    """Freeze the pod in control, and see the robot be handed over by its policy's first strategy; who drives it then."""
    robot.fail(active, "frozen")  # a killed container is back before its policy is out of patience
    recovery = robot.wait_recovered(number)
    strategy = {EXECUTING: "Fallback/Executing", UNINITIALIZED: "Fallback/Uninitialized"}[policy]
    assert (recovery.strategy, recovery.old) == (strategy, active), recovery
    assert_handed_over(robot, recovery, expires=expires)
    return recovery.new


@pytest.mark.long
def test_an_upgrade_from_the_previous_version_leaves_no_gap_at_the_robots(
    earlier: Version, kubectl: Kubectl, release: Kubectl
) -> None:
    pooled, standing, active = driven(kubectl)
    robots = {pooled: UNINITIALIZED, standing: EXECUTING}
    # The one that waits then was made by the workload's own controller.
    active[standing] = lose(standing, active[standing], EXECUTING, number=1, expires=False)
    failures = {pooled: 0, standing: 1}
    for robot in robots:
        assert robot.wait_protected() == active[robot]
    for robot, pod in active.items():
        everything = [kubectl.get("pod", pod), *standbys(robot, pod), *robot.monitor_pods(), *held(kubectl)]
        assert all(tags(found) == {earlier.tag} for found in everything), "all of it is of the version before"
        assert robot.condition("OutputsRead") == {}, "which doesn't know that yet"
    assert [tags(pod) for pod in operators(release)] == [{earlier.tag}] * 2
    assert {version(release, pod) for pod in operators(release)} == {EARLIER_VERSION}
    assert "OutputsRead" not in definition(release)

    time.sleep(BEFORE)
    begun = time.time()
    install(release.kubeconfig)
    installed = time.time()
    assert "OutputsRead" in definition(release), "Helm upgrades the definitions too"
    [listed] = json.loads(helm(release.kubeconfig, "list", "--namespace", SYSTEM, "--output", "json"))
    assert (listed["chart"], listed["app_version"]) == (f"understudy-{__version__}", __version__)
    assert [tags(pod) for pod in operators(release)] == [{PRESENT}] * 2
    assert [version(release, pod) for pod in operators(release)] == [__version__] * 2

    def renewed() -> bool:
        assert {robot: len(robot.recoveries()) for robot in robots} == failures, "nothing is taken for a failure"
        return all_around(robots, active, PRESENT)

    eventually(renewed, within=240, what="all around the robots is of this version", note=pooled.describe)
    for robot in robots:
        robot.wait_protected()
        eventually(
            lambda robot=robot: robot.condition("OutputsRead").get("status") == "True",  # type: ignore[misc]
            within=60, what="the monitor tells what only this version knows", note=robot.describe,
        )  # fmt: skip
    time.sleep(2)
    ended = time.time()
    print(f"\nupgrade from {EARLIER_VERSION}: helm {installed - begun:.1f} s, all of it {ended - begun:.1f} s")
    silences = []
    for robot, policy in robots.items():
        log = robot.log()
        during, before = log.between(begun, ended), log.between(begun - BEFORE, begun)
        longest, usual = during.longest_silence(), before.longest_silence()
        assert longest is not None
        assert usual is not None
        silences.append(longest.seconds)
        [monitor] = living(robot.monitor_pods())
        print(
            f"{policy}: {len(during.commands)} commands, the longest time without one {longest.seconds * 1000:.0f} ms "
            f"({usual.seconds * 1000:.0f} ms in {BEFORE:.0f} s before); the monitor's pod was ready after {starting(monitor):.0f} s"
        )
        assert during.sources() == [active[robot]], "one pod drove all the while"
        assert len(robot.recoveries()) == failures[robot], "and nothing was taken for a failure"
        assert (tags(monitor), version(kubectl, monitor)) == ({PRESENT}, __version__)
        assert tags(kubectl.get("pod", active[robot])) == {earlier.tag}, "the pod in control stays, with its agent"

    first, second = sorted(start(pod) for robot in robots for pod in living(robot.monitor_pods()))
    assert first[1] <= second[0], "their monitors were replaced one after the other"

    for robot, policy in robots.items():
        assert tags(kubectl.get("pod", lose(robot, active[robot], policy, number=failures[robot] + 1))) == {PRESENT}
    for robot in robots:
        robot.wait_protected()
        eventually(
            lambda robot=robot: all(tags(pod) == {PRESENT} for pod in robot.pods()),  # type: ignore[misc]
            within=60, what="nothing is left of the version before", note=robot.describe,
        )  # fmt: skip
    assert max(silences) <= LONGEST, "no gap was in the upgrade"


@pytest.mark.long
def test_a_rollback_to_the_previous_version_leaves_no_gap_at_the_robots_after_a_failback(
    earlier: Version, kubectl: Kubectl, release: Kubectl
) -> None:
    install(release.kubeconfig)
    eventually(
        lambda: [tags(pod) for pod in release.list("pods", OPERATORS)] == [{PRESENT}] * 2,
        within=60, what="no operator of the version before is left, which would still build", note=lambda: release("get", "pods"),
    )  # fmt: skip
    pooled, standing, active = driven(kubectl)
    robots = {pooled: UNINITIALIZED, standing: EXECUTING}
    # A recovery that this version has written beside the gate and into the status, as the one before must be able to read it.
    active[pooled] = lose(pooled, active[pooled], UNINITIALIZED, number=1)
    failures = {pooled: 2, standing: 0}  # the failback counts too
    assert pooled.wait_protected() == active[pooled]
    # That version finds a claimed pod by a label, which claims of this one do not change, so it would take the robot from it.
    assert understudy(kubectl, "failback", pooled.workload, "--yes").returncode == 0
    active[pooled] = pooled.wait_protected()

    begun = time.time()
    helm(release.kubeconfig, "rollback", "understudy", "--namespace", SYSTEM, "--wait", "--timeout", "180s")
    rolled = time.time()
    assert {version(release, pod) for pod in operators(release)} == {EARLIER_VERSION}
    assert "OutputsRead" not in definition(release), "Helm takes the definitions back too"
    eventually(
        lambda: all_around(robots, active, earlier.tag),
        within=240, what="all around the robots is of the version before", note=pooled.describe,
    )  # fmt: skip
    for robot in robots:
        assert robot.wait_protected() == active[robot]
    ended = time.time()
    print(f"\nback to {EARLIER_VERSION}: helm {rolled - begun:.1f} s, all of it {ended - begun:.1f} s")
    for robot, policy in robots.items():
        during = robot.log().between(begun, ended)
        longest = during.longest_silence()
        assert longest is not None
        print(
            f"{policy}: {len(during.commands)} commands, the longest time without one {longest.seconds * 1000:.0f} ms"
        )
        assert during.sources() == [active[robot]], "one pod drove all the while"
        assert len(robot.recoveries()) == failures[robot], (
            "nothing was taken for a failure, and what was recorded is known"
        )
        assert tags(kubectl.get("pod", active[robot])) == {PRESENT}, "the pod in control stays, with its agent"
    for robot, policy in robots.items():
        found = lose(robot, active[robot], policy, number=failures[robot] + 1, expires=False)
        assert tags(kubectl.get("pod", found)) == {earlier.tag}


@pytest.mark.long
def test_a_monitor_with_a_user_s_older_image_works_until_the_image_is_rebuilt(
    earlier: Version, kubectl: Kubectl, release: Kubectl
) -> None:
    """It asks for all FailurePolicies of the namespace, which one of this version may not."""
    robot = Robot(kubectl)
    own = f"localhost/understudy-monitor:{earlier.tag}"

    def pinned(workload: Object) -> None:
        workload["spec"]["monitor"] = {"image": own}

    kubectl.apply(strategies() + robot.objects(policy=EXECUTING, labels=STANDING, edit=pinned))
    active = robot.wait_protected()
    install(release.kubeconfig)
    eventually(
        lambda: [tags(pod) for pod in living(release.list("pods", OPERATORS))] == [{PRESENT}] * 2,
        within=60, what="the operators are of this version", note=lambda: release("get", "pods"),
    )  # fmt: skip
    user = account(kubectl.namespace, names.monitor_account(robot.workload))

    def policies_read() -> set[str] | None:
        rights = listed(kubectl("auth", "can-i", "--list", f"--as={user}"))
        return named(rights).get("failurepolicies.understudy.dev")

    for monitor in living(robot.monitor_pods()):
        kubectl("delete", "pod", monitor["metadata"]["name"])
    assert robot.wait_protected() == active
    # The standby may still be the one of the version before: an operator of this one leads only after a moment.
    active = lose(robot, active, EXECUTING, number=1, expires=False)
    assert [tags(monitor) for monitor in living(robot.monitor_pods())] == [{earlier.tag}]
    assert policies_read() is None, "it has the right to all of them still"
    assert f"monitor of {robot.workload}" in understudy(kubectl, "doctor", "--no-pods").stdout

    again = {"spec": {"monitor": {"image": f"localhost/understudy-monitor:{PRESENT}"}}}
    kubectl("patch", "robotworkload", robot.workload, "--type=merge", "--patch", json.dumps(again))
    eventually(
        lambda: policies_read() == {EXECUTING}, within=90, what="the new one reads its own only", note=robot.describe
    )
    assert robot.wait_protected() == active
    lose(robot, active, EXECUTING, number=2)
    assert f"monitor of {robot.workload}" not in understudy(kubectl, "doctor", "--no-pods").stdout
