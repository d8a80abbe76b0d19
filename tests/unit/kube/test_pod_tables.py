"""Pods by the table that an API server makes of them."""

from __future__ import annotations

from typing import Any

import pytest

from understudy.kube import pod_tables
from understudy.kube.client import Object

HEAD = ["Name", "Ready", "Status", "Restarts", "Age", "IP", "Node", "Nominated Node", "Readiness Gates"]
ROW: list[Any] = ["spare-x7k2p", "2/2", "Running", 0, "41s", "10.0.0.7", "node2", "<none>", "<none>"]


def table(**cells: str) -> Object:
    """As Kubernetes 1.34 answers with ``includeObject=None``."""
    row = [cells.get(name.replace(" ", "_"), cell) for name, cell in zip(HEAD, ROW, strict=True)]
    columns = [{"name": name, "type": "string", "format": "", "description": "", "priority": 0} for name in HEAD]
    return {"kind": "Table", "columnDefinitions": columns, "rows": [{"cells": row, "object": None}]}


def pods(answer: Object) -> list[Object]:
    return pod_tables.pods(answer, namespace="fleet", labels={"pool": "spare"})


@pytest.mark.parametrize(
    ("cells", "ready"),
    [
        ({}, "True"),
        ({"Ready": "1/2"}, "False"),
        ({"Ready": "10/10"}, "True"),
        ({"Readiness_Gates": "1/1"}, "True"),
        ({"Readiness_Gates": "0/1"}, "False"),
        ({"Status": "Terminating"}, "False"),
        ({"Status": "NotReady"}, "False"),
    ],
)
def test_the_ready_condition_of_a_pod_comes_from_its_table_row(cells: dict[str, str], ready: str) -> None:
    [pod] = pods(table(**cells))
    assert pod["status"]["conditions"] == [{"type": "Ready", "status": ready}]


def test_a_pod_has_its_name_node_and_requested_fields() -> None:
    [pod] = pods(table())
    assert pod["metadata"] == {
        "name": "spare-x7k2p",
        "uid": "spare-x7k2p",
        "namespace": "fleet",
        "labels": {"pool": "spare"},
    }
    assert pod["spec"]["nodeName"] == "node2"


@pytest.mark.parametrize("rows", [None, []])
def test_an_empty_table_has_no_pods(rows: Any) -> None:
    assert pods({**table(), "rows": rows}) == []


def test_a_server_without_table_support_is_supported() -> None:
    items = [{"metadata": {"name": "spare-1"}}]
    assert pods({"kind": "PodList", "items": items}) == items
    assert pods({"kind": "PodList", "items": None}) == []
