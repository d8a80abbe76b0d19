"""The words that ``understudy init`` writes for what it cannot know, and finds them in manifests where nobody replaced them.

None of them is a valid name or image, because Kubernetes allows no upper-case letters there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from understudy.cli.manifests.manifest_reader import at, items

ROBOT = "ROBOT"
"""Name of what runs the robot's drivers."""
CONTAINER = "CONTAINER"
"""Name of its container."""
IMAGE = "IMAGE"
"""Image of the mux."""


def problems(manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the path of each placeholder in a patch for a controller, and what to replace it by."""
    if at(manifest, "metadata", "name") == ROBOT:
        yield (
            "metadata.name",
            f"{ROBOT} is a placeholder: replace it by the name of what runs the robot's drivers. If nothing in the cluster does, remove "
            "this patch",
        )
    for number, container in enumerate(items(manifest, "spec", "template", "spec", "containers")):
        path = f"spec.template.spec.containers[{number}]"
        if at(container, "name") == CONTAINER:
            yield (
                f"{path}.name",
                f"{CONTAINER} is a placeholder: replace it by the name of the container of the robot's drivers",
            )
        if at(container, "image") == IMAGE and "mux" in items(container, "args"):
            yield (
                f"{path}.image",
                f"{IMAGE} is a placeholder: replace it by the image of the monitor, the chart's value images.monitor",
            )
