"""Everything the demo plays on: a cluster, the images, the chart. What was there before is used, and left as it was."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from understudy_demo.kubectl import CommandFailed, run

REPOSITORY = Path(__file__).resolve().parents[2]
RELEASE = "understudy"
RELEASE_NAMESPACE = "understudy-system"
BUILT = "localhost"
"""The registry in the names of images that were built here, which no node would ever pull from."""

IMAGES = ("operator", "monitor", "quickstart")
"""Those that the play needs, by the names that scripts/images has for them; others take long to build."""

Say = Callable[[str], None]


class Stage:
    """Sets up, remembers what it made, and takes that down again."""

    def __init__(self, provider: str | None, say: Say, *, registry: str | None = None) -> None:
        """``registry`` has the images, where none are to be built."""
        self._say = say
        self._build = registry is None
        self._images = registry or BUILT
        self.environment = dict(os.environ)
        if provider:
            self.environment["UNDERSTUDY_CLUSTER_PROVIDER"] = provider
        self._made_cluster = False
        self._made_release = False
        self._made_kinds = False
        self.release_namespace = RELEASE_NAMESPACE

    def _script(self, *command: str, timeout: float = 3600.0, show: bool = False) -> str:
        return run(
            [str(REPOSITORY / "scripts" / command[0]), *command[1:]], self.environment, timeout=timeout, show=show
        )

    def cluster(self) -> None:
        """A cluster that can be used, and a kubectl that finds it."""
        try:
            self._script("cluster", "status", timeout=60)
        except CommandFailed:
            self._say("cluster: scripts/cluster up")
            self._made_cluster = True
            self._script("cluster", "up", show=True)
        else:
            self._say("cluster: there already")
        self.environment["KUBECONFIG"] = self._script("cluster", "kubeconfig").strip()

    def status(self) -> str:
        """The cluster in a line."""
        return self._script("cluster", "status", timeout=60).partition("\n")[0]

    def images(self) -> None:
        """The images, on every node."""
        if not self._build:
            self._say(f"images: those at {self._images}")
            return
        self._say(f"images: scripts/images --load {' '.join(IMAGES)}")
        self._script("images", "--load", *IMAGES, show=True)

    def chart(self) -> None:
        """The operator, by its chart and by nothing else."""
        if shutil.which("helm", path=self.environment["PATH"]) is None:
            lib = REPOSITORY / "scripts" / "lib.sh"
            run(
                ["bash", "-ec", f". '{lib}'; python_environment; helm_program"],
                self.environment,
                timeout=900,
                show=True,
            )
        self._made_kinds = not self._kinds()
        releases = json.loads(run(["helm", "list", "-A", "--all", "-o", "json"], self.environment))
        ours = [r for r in releases if r["chart"].startswith("understudy-")]
        if ours:
            self.release_namespace = ours[0]["namespace"]
            if not self._is_demos(ours[0]["name"]):
                self._say(f"chart: {ours[0]['name']} in {self.release_namespace} is not the demo's; using it as it is")
                return
            self._say(f"chart: upgrading {ours[0]['name']} in {self.release_namespace}")
        else:
            self._say(f"chart: installing {RELEASE} in {RELEASE_NAMESPACE}")
            self._made_release = True
        values = {
            "images.operator.repository": f"{self._images}/understudy-operator",
            "images.operator.tag": "dev",
            "images.monitor.repository": f"{self._images}/understudy-monitor",
            "images.monitor.tag": "dev",
            # The tag stays the same when the image changes; with this its pods are replaced then.
            r"operator.podAnnotations.understudy\.dev/image": self._operator_image(),
        }
        name = ours[0]["name"] if ours else RELEASE
        settings = ["--set", "allNamespaces=true"]
        settings += [word for key, value in values.items() for word in ("--set-string", f"{key}={value}")]
        command = ["helm", "upgrade", "--install", name, str(REPOSITORY / "charts" / "understudy"), *settings]
        command += ["--namespace", self.release_namespace, "--create-namespace", "--wait", "--timeout", "180s"]
        run(command, self.environment, timeout=240)

    def _is_demos(self, name: str) -> bool:
        """Whether an installed release runs the demo's images; another one is not ours to upgrade."""
        command = ["helm", "get", "values", name, "-n", self.release_namespace, "-o", "json"]
        values = json.loads(run(command, self.environment)) or {}
        repository = values.get("images", {}).get("operator", {}).get("repository", "")
        return str(repository) == f"{self._images}/understudy-operator"

    def _operator_image(self) -> str:
        """Identifies the image that scripts/images built last."""
        cache = Path(self.environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "understudy"
        try:
            built = json.loads((cache / "images" / "built.json").read_text())
        except (OSError, ValueError):
            return "unknown"
        return "-".join(entry["image"][-12:] for name, entry in sorted(built.items()) if "understudy-operator" in name)

    def _kinds(self) -> list[str]:
        text = run(["kubectl", "get", "crd", "-o", "name"], self.environment)
        return [line for line in text.splitlines() if line.endswith(".understudy.dev")]

    def remove(self) -> None:
        """Take down what :meth:`cluster` and :meth:`chart` made; the demo's namespace is gone already."""
        if self._made_cluster:
            self._say("removing the cluster: scripts/cluster down")
            self._script("cluster", "down", show=True)
            return
        if self._made_release:
            self._say(f"removing the chart: helm uninstall {RELEASE} -n {RELEASE_NAMESPACE}")
            run(["helm", "uninstall", RELEASE, "-n", RELEASE_NAMESPACE, "--wait"], self.environment)
            run(["kubectl", "delete", "namespace", RELEASE_NAMESPACE, "--timeout=120s"], self.environment, timeout=150)
        if self._made_kinds:
            run(["kubectl", "delete", *self._kinds(), "--timeout=60s"], self.environment)
        kept = "the cluster was" if self._made_release else "cluster and chart were"
        self._say(f"{kept} there before, and left there")

    def left(self) -> list[str]:
        """The commands that remove what a kept demo leaves."""
        if self._made_cluster:
            return ["scripts/cluster down"]
        commands = []
        if self._made_release:
            commands.append(f"helm uninstall {RELEASE} -n {RELEASE_NAMESPACE}")
        return commands
