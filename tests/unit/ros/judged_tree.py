"""Health trees over what is really received."""

from __future__ import annotations

import json
import time
from typing import Any

from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.runtime.interface_types import message_fields
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.languages.short.health_loader import load


def tell(node: Any, **fields: Any) -> None:
    """Have a node that says messages say these fields from now on."""
    node.stdin.write(json.dumps(fields) + "\n")
    node.stdin.flush()


class Judged:
    """A tree over what is really received."""

    def __init__(self, watching: TopicWatch, tree: dict[str, Any], grace: float = 30.0) -> None:
        self.tree: HealthTree = load(tree, grace=grace, fields=message_fields)
        self.since, self._watching = time.time(), watching
        watching.follow(self.tree.topics)

    def now(self) -> Verdict:
        self._watching.drain()
        return self.tree.evaluate(self._watching, now=time.time(), since=self.since)

    def until_failed(self) -> Verdict:
        """Returns the first verdict that is not Healthy, and checks that it does not come before the announced deadline."""
        due, end = None, time.time() + 20
        while (verdict := self.now()).state == "Healthy":
            assert time.time() < end
            due = self.deadline() or due
            time.sleep(0.005)
        assert due is None or due <= time.time(), "it fails at the deadline, not before"
        return verdict

    def deadline(self) -> float | None:
        return self.tree.deadline(self._watching, now=time.time(), since=self.since)
