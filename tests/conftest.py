"""Options and fixtures of all tests.

``scripts/test`` provides all that tests need and then sets UNDERSTUDY_TEST, so that nothing is skipped there. With plain
pytest what isn't there is skipped with the reason.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import time
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import urllib3

from testcluster.cli import select
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError
from tests.support import golden
from tests.support.cluster import Cluster

# MuJoCo looks for what it renders with when it is imported first, by whichever test.
os.environ.setdefault("MUJOCO_GL", "egl")

REPOSITORY = Path(__file__).resolve().parent.parent
MACHINE_NETWORK = "UNDERSTUDY_TEST_NETWORK"
"""Environment variable of a test process that has a network of its own: the file of the machine's, for nsenter."""
_CLONE_NEWNS, _CLONE_NEWNET = 0x00020000, 0x40000000
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "understudy"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("understudy")
    group.addoption(
        "--cluster",
        choices=["local", "kind", "current"],
        default=os.environ.get("UNDERSTUDY_CLUSTER_PROVIDER") or None,
        help="which cluster to test on: the project's own, one of kind, or that of the current kubeconfig",
    )
    group.addoption(
        "--kubeconfig", type=Path, default=None, help="kubeconfig of the cluster (default: asks scripts/cluster)"
    )
    group.addoption(
        "--part",
        choices=["all", "side-by-side", "alone"],
        default="all",
        help="of the tests on a cluster: those that can run beside others, or those marked `alone`",
    )


def pytest_configure(config: pytest.Config) -> None:
    # A shell ignores SIGINT for what it runs in the background, and a program can't undo that for itself: tests send it.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # pytest 9.1 loses the fixtures of a folder between whose files stands one of a parent folder (pytest issue 14640).
    config.args.sort()
    # kubectl and helm of the project, where the machine has none.
    os.environ["PATH"] = f"{_CACHE / 'tools'}{os.pathsep}{os.environ['PATH']}"
    # None of several test processes is to hear what another one's robots say. A cluster is reached by the machine's network only.
    if "PYTEST_XDIST_WORKER" in os.environ and os.geteuid() == 0 and not _on_a_cluster(config.args):
        _like_a_pod()


def _on_a_cluster(arguments: Iterable[str]) -> bool:
    """Whether one of the files and folders to be tested needs a cluster."""
    paths = [Path(argument.partition("::")[0]).resolve() for argument in arguments]
    return any(path.is_relative_to(REPOSITORY / "tests" / folder) for path in paths for folder in ("cluster", "e2e"))


def _like_a_pod() -> None:
    """Give this process a network and a shared memory of its own: the middleware's transports.

    By its shared memory two processes that listen on the same gate port would meet whatever their networks are, and
    what a killed one leaves there would stay.
    """
    # What loads packages runs in the machine's network: see MACHINE_NETWORK.
    os.environ[MACHINE_NETWORK] = f"/proc/{os.getpid()}/fd/{os.open('/proc/self/ns/net', os.O_RDONLY)}"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET | _CLONE_NEWNS):
        raise pytest.UsageError(f"no network of its own for a test process: {os.strerror(ctypes.get_errno())}")
    for command in (
        "ip link set lo up",
        "mount --make-rslave /",
        "mount -t tmpfs -o mode=1777 understudy /dev/shm",
    ):
        subprocess.run(command.split(), check=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests by their folder, leave out the other part, and skip what the provider can't do."""
    on_a_cluster = []
    for item in items:
        for folder in ("cluster", "e2e"):
            if item.path.is_relative_to(REPOSITORY / "tests" / folder):
                item.add_marker(getattr(pytest.mark, folder))
                on_a_cluster.append(item)
    part = config.getoption("part")
    if part != "all":
        left_out = {
            item for item in on_a_cluster if (item.get_closest_marker("alone") is None) != (part == "side-by-side")
        }
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    local_only = [item for item in items if item.get_closest_marker("local_only")]
    if local_only and (provider := config.getoption("cluster") or _suitable_provider()) != "local":
        for item in local_only:
            item.add_marker(pytest.mark.skip(reason=f"only the local provider can do this, not {provider}"))


def _suitable_provider() -> str | None:
    """The provider that scripts/cluster takes on this machine, if there is one."""
    try:
        return select(None, None, Progress()).name
    except ClusterError:
        return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tells the golden files which test begins."""
    golden.begin(f"{item.path.stem}::{item.name}")


def pytest_internalerror(excinfo: pytest.ExceptionInfo[BaseException]) -> None:
    """Keep an error of pytest itself for the end of scripts/test. That of a test process contains its traceback."""
    _keep("pytest itself", str(excinfo.value))


def _keep(what: str, error: str) -> None:
    """Keep the end of an error for the end of scripts/test."""
    if "PYTEST_XDIST_WORKER" not in os.environ and (log := os.environ.get("UNDERSTUDY_FAILURES")):
        with open(log, "a") as writing:
            writing.write(f"{what}\n{error[-4000:]}\n\n")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Reports how long scripts/test took, why a test failed that was run again, and what failed before the tests began."""
    if started := os.environ.get("UNDERSTUDY_STARTED"):
        terminalreporter.line("")
        terminalreporter.line(f"scripts/test took {time.time() - float(started):.0f} s in all")
    for report in (*terminalreporter.stats.get("failed", ()), *terminalreporter.stats.get("error", ())):
        _keep(f"{report.nodeid} ({report.when})", report.longreprtext)
    if again := terminalreporter.stats.get("rerun"):
        terminalreporter.section("why a test failed that was run again")
        for report in again:
            terminalreporter.line(f"{report.nodeid} ({report.when})", bold=True)
            terminalreporter.line(report.longreprtext[-4000:])
    failed = [name for name in os.environ.get("UNDERSTUDY_FAILED", "").split(";") if name]
    if failed:
        terminalreporter.section("failed before the tests", red=True)
        for name in failed:
            terminalreporter.line(f"FAILED {name} (see above)")


def unavailable(reason: str) -> None:
    """Skip, or fail where scripts/test should have provided it."""
    if os.environ.get("UNDERSTUDY_TEST"):
        pytest.fail(reason)
    pytest.skip(reason)


def program(name: str) -> str:
    """The path of a program that scripts/test builds."""
    found = shutil.which(name)
    if found is None:
        unavailable(f"there is no {name}: scripts/test builds one")
    assert found is not None
    return found


@pytest.fixture(scope="session")
def helm() -> str:
    """The path of helm."""
    return program("helm")


@pytest.fixture(scope="session")
def kubeconfig(pytestconfig: pytest.Config) -> Path:
    """The kubeconfig of the cluster under test: --kubeconfig, or what scripts/cluster says.

    $KUBECONFIG counts with ``--cluster current`` only: tests install and remove things, and it may be anybody's cluster.
    """
    provider: str | None = pytestconfig.getoption("cluster")
    given: Path | None = pytestconfig.getoption("kubeconfig")
    if given is None:
        command = [
            str(REPOSITORY / "scripts" / "cluster"),
            "kubeconfig",
            *(["--provider", provider] if provider else []),
        ]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            unavailable(f"there is no cluster ({done.stderr.strip()}): scripts/test cluster brings one up")
        given = Path(done.stdout.strip())
    if not given.is_file():
        unavailable(f"there is no kubeconfig {given}: scripts/test cluster brings a cluster up")
    # What is started from here (helm, kubectl, the code under test) means the same cluster.
    os.environ["KUBECONFIG"] = str(given)
    return given


@pytest.fixture(scope="session")
def cluster(kubeconfig: Path) -> Cluster:
    """The cluster under test."""
    found = Cluster(kubeconfig)
    try:
        found.request("GET", "/version")
    except urllib3.exceptions.HTTPError as error:
        unavailable(f"the cluster of {kubeconfig} doesn't answer: {error}")
    return found


@pytest.fixture
def namespace(cluster: Cluster) -> Iterator[str]:
    """A namespace of one test's own."""
    name = f"test-{uuid.uuid4().hex[:8]}"
    item = cluster.create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": name}})
    yield name
    cluster.delete(item)
