"""The navigation example with Nav2 itself: the same robot and the same client."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from navigation_world import generate
from navigation_world.files import write

from testcluster.images.catalog import NAV2_ARCHIVE
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.navigation import CONTAINER, Navigator

SEED = 7
"""Of the world that the manifests are for."""

IMAGE = "understudy-nav2"

MISSING = (
    f"no node has the image {IMAGE}: scripts/images makes it of an archive that {NAV2_ARCHIVE} names; "
    "elsewhere it is built from ros:jazzy"
)

SIGNAL = """
import os, signal, sys
from pathlib import Path
number, nodes, sent = signal.Signals["SIG" + sys.argv[1]], sys.argv[2:], []
for process in Path("/proc").glob("[0-9]*"):
    try:
        words = (process / "cmdline").read_text().split("\\0")
    except OSError:
        continue
    program = next((Path(word) for word in words[:2] if word.startswith("/opt/nav2/")), None)
    if program and (not nodes or program.name in nodes):
        os.kill(int(process.name), number)
        sent.append(program.name)
sys.exit(f"not running: {sorted(set(nodes) - set(sent)) or 'Nav2'}" if not sent or set(nodes) - set(sent) else 0)
"""
"""Run in a pod of Nav2: sends a signal to nodes, or to all of them and to the process that started them."""


def has_image(kubectl: Kubectl) -> bool:
    """Return whether a node has the image."""
    images = [image for node in kubectl.list("nodes") for image in node["status"].get("images", ())]
    return any(IMAGE in name for image in images for name in image.get("names") or ())


class Nav2(Navigator):
    """A mobile robot with Nav2 and a client."""

    FOLDER = "nav2"
    LOCATED_IN = CONTAINER
    POSES = 1
    """Nav2's AMCL publishes one for each 0.25 m."""

    def _files(self, configuration: str) -> Iterable[Path]:
        here = self._manifests.parent / self.FOLDER
        return here / f"strategies/{configuration}.yaml", here / "workload.yaml", self._manifests / "robot.yaml"

    def set_up(self, configuration: str, *, edit: Callable[[list[Object]], None] | None = None) -> None:
        """Apply the map, policy, pool, workload and robot; ``edit`` may change all but the map first."""
        with tempfile.TemporaryDirectory() as made:
            write(generate(SEED), Path(made))
            files = [f"--from-file={Path(made) / name}" for name in ("map.yaml", "map.pgm")]
            self.kubectl("create", "configmap", "navigation-map", *files)
        super().set_up(configuration, edit=edit)

    def send_signal(self, pod: str, number: str, *nodes: str) -> None:
        """Send a signal to nodes of a pod, or to all of Nav2."""
        self.kubectl.kill(pod, "python3", "-c", SIGNAL, number, *nodes, container=CONTAINER)
