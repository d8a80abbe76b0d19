"""What ``understudy explain`` knows of a robot, and says of it."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import Any

from tests.support import fleet
from understudy.cli.inspect.cluster_observation import WorkloadObjects, observed_from
from understudy.cli.inspect.explanation import Facts, lines
from understudy.kube.client import Object
from understudy.kube.gates import registry


class Nothing:
    """Returns no other objects."""

    async def find(self, *_: Any) -> Object | None:
        await asyncio.sleep(0)
        return None

    async def list(self, *_: Any, **__: Any) -> Object:
        await asyncio.sleep(0)
        return {"items": []}


def known(item: Object, items: list[Object] | None = None, *events: Object) -> Facts:
    observed = observed_from(item, items if items is not None else fleet.around(item), Nothing())
    others = [one for one in items or [] if one["kind"] == "RobotWorkload"]
    gates = {one["metadata"]["name"]: one for one in items or [] if one["kind"] in registry.OBJECT_KINDS}
    return Facts.of(WorkloadObjects(dataclasses.replace(observed, now=fleet.NOW), events, others, gates))


def explained_lines(found: Facts, columns: int | None = None) -> dict[str, list[str]]:
    """The lines by their heading, those above all under none."""
    sections: dict[str, list[str]] = {"": []}
    for line in lines(found, columns=columns, colours=False):
        if line and not line.startswith(" ") and sections[""]:
            sections[line] = []
        elif line:
            sections[list(sections)[-1]].append(line.strip())
    return sections
