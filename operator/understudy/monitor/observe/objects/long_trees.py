"""Trees that may take long to read.

The operator has another process read every tree, and ends it after a few seconds. The monitor waits for the operator's verdict
about long trees, and does not read those that were refused. It reads the others in another thread first, because its event loop
would do nothing else meanwhile: what that thread parses is remembered.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator, Sequence
from typing import Any

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.kinds.tree_spec import Written
from understudy.api.nesting import DEEPEST
from understudy.kube.client import Object
from understudy.monitor.observe.wakeups import Wakeups
from understudy.ros.runtime.interface_types import message_fields
from understudy.trees.languages.notations import TEXTS, load_inline
from understudy.trees.languages.procedure_notations import composed
from understudy.trees.languages.tree_check import INVALID, TOO_COSTLY
from understudy.trees.source.expressions import Fields
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)

LONG = 3000
"""Characters of all texts of an object together that are read within 50 ms in every language."""

SHORT_FORM = 16
"""As many characters of a tree in the short form take as long to read as one of a text: most of them are in conditions over messages."""


def unaccepted(item: Object) -> bool:
    """Return whether the object has long trees that the operator has not judged yet, or has refused."""
    if not _are_long(item.get("spec")):
        return False
    status = item.get("status") or {}
    if status.get("observedGeneration") != item["metadata"].get("generation"):
        return True
    reasons = {one.get("reason") for one in status.get("conditions") or [] if one.get("type") == "Accepted"}
    return bool(reasons & {INVALID, TOO_COSTLY})


def _are_long(value: Any) -> bool:
    """Return whether the fields in a value that hold trees are long together."""
    return sum(_lengths(value, DEEPEST)) > LONG


def _lengths(value: Any, levels: int, *, in_tree: bool = False) -> Iterator[float]:
    """Yield the lengths of the texts of trees, and of all texts in trees in the short form."""
    if isinstance(value, str):
        if in_tree:
            yield len(value) / SHORT_FORM
    elif levels == 0:
        return
    elif isinstance(value, dict):
        for name, inner in value.items():
            if name in TEXTS and isinstance(inner, str):
                yield len(inner)
            else:
                yield from _lengths(inner, levels - 1, in_tree=in_tree or name == "yaml")
    elif isinstance(value, list):
        for inner in value:
            yield from _lengths(inner, levels - 1, in_tree=in_tree)


Trees = Sequence[tuple[str, Written]]
"""Trees with their paths for messages."""


def of_policy(spec: FailurePolicySpec) -> Trees:
    """Return the trees of a policy, in the order in which they are to be read: the last ones are remembered best."""
    inline = ((f"spec.{path}", one) for path, one in spec.inline_trees)
    return [*spec.recoveries, *inline, ("spec.monitoring", spec.monitoring)]


def procedures_of(spec: RobotWorkloadSpec) -> Sequence[tuple[str, Procedure]]:
    """Return the procedures of a workload."""
    found = [(f"dependsOn[{i}].procedure", one.procedure) for i, one in enumerate(spec.depends_on)]
    return [(path, one) for path, one in (("bringUp", spec.bring_up), *found) if one is not None]


class ReadAhead:
    """Reads the trees of the versions of one object in another thread."""

    def __init__(self, wakeups: Wakeups) -> None:
        self.revision = 0
        """A value that changes whenever the trees of a version have been read."""
        self._wakeups = wakeups
        self._done, self._readable = "", True
        """The version whose trees were read last, and whether they could be."""
        self._task: asyncio.Task[None] | None = None

    def has_read(self, version: str, trees: Trees, group: asyncio.TaskGroup) -> bool:
        """Return whether the event loop may read the trees of a version. If not, they are read ahead, and then the monitor evaluates."""
        if version == self._done:
            return self._readable
        slow = [(path, tree) for path, tree in trees if tree.form == "osc" or _are_long({tree.form: tree.tree})]
        if not slow:
            return True
        if self._task is None:
            self._task = group.create_task(self._ahead(version, slow))
        return False

    async def _ahead(self, version: str, trees: Trees) -> None:
        self._readable = False
        try:
            await asyncio.to_thread(read, trees, message_fields)
            self._readable = True
        except Exception:  # the monitor would end by it
            _logger.exception("trees cannot be read, and the last ones stay in use")
        self._done, self._task = version, None
        self.revision += 1
        self._wakeups.trees_read()


def read(trees: Trees, fields: Fields | None = None) -> None:
    """Read trees, so that reading them again with the same ``fields`` is quick."""
    for path, tree in trees:
        with contextlib.suppress(TreeError):  # which whoever uses the tree reports
            if isinstance(tree, Procedure):
                composed(tree, path=path)
            else:
                load_inline(tree, path=path, grace=0.0, fields=fields)
