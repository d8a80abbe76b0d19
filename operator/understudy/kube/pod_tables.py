"""Running pods by the table that the API server makes of them (meta.k8s.io/v1 Table), without the pods themselves.

Whoever chooses one of many needs to know which are ready, and nothing else of each: of a pod of 10 kB, that is 150 bytes. The one that
was chosen is read whole with the answer to its claim.
"""

from __future__ import annotations

from collections.abc import Mapping

from understudy.kube.client import Object

NONE = "<none>"
"""A cell of what a pod hasn't got."""


def pods(answer: Object, *, namespace: str, labels: Mapping[str, str]) -> list[Object]:
    """The pods of a table of running ones that have some labels: name, node and whether each is ready. In place of its UID, which
    isn't told, a pod has its name. Where a server answered with a list: the pods as they are.
    """
    if answer.get("kind") != "Table":
        return answer.get("items") or []
    columns = [column["name"] for column in answer["columnDefinitions"]]
    rows = [dict(zip(columns, row["cells"], strict=True)) for row in answer.get("rows") or []]
    return [_pod(cells, namespace, labels) for cells in rows]


def _pod(cells: Mapping[str, object], namespace: str, labels: Mapping[str, str]) -> Object:
    ready = cells["Status"] == "Running" and _all(cells["Ready"]) and _all(cells.get("Readiness Gates", NONE))
    return {
        "metadata": {"name": cells["Name"], "uid": cells["Name"], "namespace": namespace, "labels": dict(labels)},
        "spec": {"nodeName": cells.get("Node"), "containers": []},
        "status": {"phase": "Running", "conditions": [{"type": "Ready", "status": "True" if ready else "False"}]},
    }


def _all(cell: object) -> bool:
    """Whether a cell such as 2/2 says that all are, or that there is nothing to count."""
    done, _, of = str(cell).partition("/")
    return cell == NONE or done == of
