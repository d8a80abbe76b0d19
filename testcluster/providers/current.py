"""Provider `current`: the cluster that kubectl uses.

It is used, but never made, changed or removed.
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path

from testcluster import packages
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError, Provider, Status
from testcluster.shell import CommandFailed, run


class CurrentProvider(Provider):
    """Somebody else's cluster."""

    name = "current"

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def _kubectl(self, *arguments: str) -> str:
        if not packages.find("kubectl"):
            raise packages.MissingPrograms(
                "provider current: the program `kubectl` is missing; it comes with your cluster's tools"
            )
        return run("kubectl", f"--kubeconfig={self.kubeconfig()}", *arguments, timeout=30)

    def up(self) -> None:
        status = self.status()
        if not status.ready:
            raise ClusterError("\n".join([status.summary, *status.details]))
        self._progress(status.summary)

    def down(self) -> None:
        self._progress("this cluster was not made by this program; it is left as it is")

    def status(self) -> Status:
        try:
            listed = json.loads(self._kubectl("get", "nodes", "-o", "json"))["items"]
        except CommandFailed as error:
            return Status(False, f"the cluster of {self.kubeconfig()} does not answer", [str(error)])
        ready = [
            item["metadata"]["name"]
            for item in listed
            if any(
                condition["type"] == "Ready" and condition["status"] == "True"
                for condition in item["status"].get("conditions", [])  # a new node has none yet
            )
        ]
        return Status(bool(ready), f"the cluster of {self.kubeconfig()}: {len(ready)} of {len(listed)} nodes are ready")

    def load_images(self, images: Sequence[str]) -> None:
        context = self._kubectl("config", "current-context").strip()
        kind = context.removeprefix("kind-")
        for image in images:
            archive = Path(image).is_file()
            if kind != context and packages.find("kind"):
                run("kind", "load", "image-archive" if archive else "docker-image", "--name", kind, image)
            elif packages.find("minikube") and context in run("minikube", "profile", "list", check=False).split():
                run("minikube", "--profile", context, "image", "load", image)
            else:
                raise ClusterError(
                    f"image {image}: how images come to the nodes of context {context} is not known here; "
                    "push it to a registry that they reach, and name that: scripts/demo --images REGISTRY, or the chart's values"
                )
            self._progress(f"{image}: loaded")

    def kubeconfig(self) -> Path:
        # As kubectl does it: the file of the home is for a variable that is not set, and not for one that names no file.
        named = os.environ.get("KUBECONFIG")
        for path in named.split(":") if named else [os.path.expanduser("~/.kube/config")]:
            if path and Path(path).is_file():
                return Path(path)
        lacks = f"KUBECONFIG={named} names no file that exists" if named else "there is no kubeconfig"
        raise ClusterError(f"provider current: {lacks}; name one in KUBECONFIG")
