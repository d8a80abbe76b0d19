"""The monitor's own pages: the live tree as JSON for tools, and as a page for people."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import cache
from importlib import resources
from typing import Any

from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.process.http_pages import HTML, JSON, Answer


class LiveTreePages:
    """Pages about the monitor's present state. They cost nothing while nobody asks for them."""

    def __init__(
        self, view: ClusterView, observer: HealthObserver, notices: Notices, notes: Callable[[], Sequence[str]] = tuple
    ) -> None:
        """``notes`` returns sentences that the page shows beside the tree."""
        self._view, self._observer, self._notices, self._notes = view, observer, notices, notes

    def state(self) -> dict[str, Any]:
        """Return the present state as plain values. Times are Unix seconds."""
        published, spec = self._notices.status, self._view.spec
        return {
            "workload": self._view.workload,
            "namespace": self._view.namespace,
            "policy": spec.failure_policy_ref.name if spec is not None else "",
            "time": round(time.time(), 3),
            "health": published.health,
            "active": published.active,
            "epoch": published.gate.epoch,
            "strategy": published.strategy,
            "conditions": [
                {"type": c.type, "status": c.status, "reason": c.reason, "message": c.message}
                for c in published.conditions
            ],
            "recoveries": published.count,
            "tree": self._observer.snapshot(),
            "notes": [*self._observer.problems, *self._observer.waiting, *self._notes()],
        }

    def tree(self) -> Answer:
        """``/tree``: the state as JSON."""
        return 200, json.dumps(self.state()) + "\n", JSON

    def page(self) -> Answer:
        """``/``: a page that draws ``tree`` repeatedly. Its addresses are relative, so that it works through proxies."""
        return 200, _page(), HTML


@cache
def _page() -> str:
    return resources.files("understudy.monitor.report").joinpath("tree.html").read_text()
