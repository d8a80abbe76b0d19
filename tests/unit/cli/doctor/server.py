"""An API server that doctor asks, for tests."""

from __future__ import annotations

from typing import Any

from understudy import __version__
from understudy.cli.common.cluster_access.kubectl_proxy import Answer, Refused
from understudy.cli.doctor.packet_check import GateTest
from understudy.kube.client import Object

ENFORCED = GateTest(
    ("n1", "n2"), before=True, established=0.03, fresh=False, others=True, opened=0.02, closed=0.01, lifted=0.04
)


class Server:
    """Answers as an API server would, by path; whatever is refused raises."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers, self.asked = answers, list[tuple[str, Any]]()

    def get(self, path: str) -> Object:
        return self.request("GET", path).body

    def request(self, method: str, path: str, body: Any = None, *, kind: str = "") -> Answer:
        self.asked.append((path, body))
        found = self.answers[path] if path in self.answers else self.answers["*"]
        found = found(body) if callable(found) else found
        if isinstance(found, Refused):
            raise found
        return Answer(found, "", 0.0, 0.0)


def deployment(version: str = __version__, ready: int = 2) -> Object:
    environment = [
        {"name": "UNDERSTUDY_MONITOR_IMAGE", "value": "registry/monitor:1"},
        {"name": "UNDERSTUDY_IMAGE_PULL_POLICY", "value": "Always"},
        {"name": "UNDERSTUDY_IMAGE_PULL_SECRETS", "value": "one,two"},
        {"name": "POD_NAME", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}},
    ]
    return {
        "metadata": {
            "namespace": "system",
            "name": "operator",
            "labels": {"app.kubernetes.io/version": version},
        },
        "spec": {
            "replicas": 2,
            "template": {"spec": {"serviceAccountName": "account", "containers": [{"env": environment}]}},
        },
        "status": {"readyReplicas": ready} if ready else {},
    }
