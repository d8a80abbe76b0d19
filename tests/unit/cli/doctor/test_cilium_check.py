"""What doctor finds on Cilium, whose policy maps are limited."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.doctor.server import Server
from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Refused
from understudy.cli.doctor import cilium_check
from understudy.cli.doctor.findings import Finding
from understudy.kube.client import CONFIG_MAPS, NETWORK_POLICIES, NODES, Object
from understudy.kube.gates.base import Reach
from understudy.kube.gates.kinds.network_policy import GATE

NAME = "robot-17-navigation"
EACH = 63
"""Entries for each peer of the instance in control: 26 of its egress, 29 of its ingress, 8 of the gate."""


def policies(reach: Reach | None = None) -> list[Object]:
    reach = reach or Reach()
    return [*(one for _, one in GATE.companions(NAME, reach)), GATE.closed(NAME, reach, epoch=0)]


def identity(number: int, **labels: str) -> Object:
    own = {"k8s:app": f"robot-{number}"} | {f"k8s:{key}": value for key, value in labels.items()}
    return {
        "security-labels": {"k8s:io.kubernetes.pod.namespace": "fleet", "k8s:io.cilium.k8s.policy.cluster": "c"} | own
    }


def found(
    identities: Any, settings: Any = None, item: Object | None = None, mine: list[Object] | None = None
) -> list[Finding]:
    answers = {
        cilium_check.IDENTITIES.path(None): {"items": identities} if isinstance(identities, list) else identities,
        CONFIG_MAPS.path("kube-system", "cilium-config"): settings or {"data": {}},
        NETWORK_POLICIES.path("fleet"): {"items": policies() if mine is None else mine},
        NODES.path(None): {
            "items": [
                {
                    "metadata": {"name": "node1"},
                    "status": {"addresses": [{"type": "InternalIP", "address": "10.0.0.7"}]},
                }
            ]
        },
    }
    return list(cilium_check.check(Server(answers), "fleet", [item or fleet.well()]))  # type: ignore[arg-type]


def test_another_network_and_robots_with_a_mux_have_no_finding() -> None:
    assert found(Refused(404, "not found")) == found(Refused(403, "forbidden")) == found([]) == []
    assert list(cilium_check.check(Server({}), "fleet", [fleet.muxed()])) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pods", "settings", "level", "fact"),
    [
        (100, {}, "OK", f"{100 * EACH} entries"),
        (200, {}, "WARN", "Past the limit"),
        (261, {}, "FAIL", "several instances may drive a robot"),
        (261, {"enable-endpoint-lockdown-on-policy-overflow": "true"}, "FAIL", "closes the gate of everybody"),
        (261, {"bpf-policy-map-max": "65536"}, "OK", "of 65536"),
    ],
)
def test_the_room_in_the_policy_map_is_compared_with_the_peers(
    pods: int, settings: dict[str, str], level: str, fact: str
) -> None:
    (finding,) = found([identity(number) for number in range(pods)], {"data": settings})
    assert (finding.check, finding.level) == ("room in Cilium", level)
    assert_golden("doctor", finding.found, fact)


def test_only_the_peers_of_a_workload_count() -> None:
    robot = {"podSelector": {"matchLabels": {"app": "robot-17"}}}
    elsewhere = identity(17)
    elsewhere["security-labels"]["k8s:io.kubernetes.pod.namespace"] = "other"
    own = identity(1, **{names.WORKLOAD: NAME})
    many = [*(identity(number) for number in range(1000)), elsewhere, own]
    (finding,) = found(many, mine=policies(Reach(peers=(robot,))))
    assert (finding.level, f"needs {EACH} entries" in finding.found) == ("OK", True)


def test_the_settings_need_not_be_readable() -> None:
    (finding,) = found([identity(1)], Refused(403, "forbidden"))
    assert "of 16384" in finding.found


@pytest.mark.parametrize(("address", "count"), [("10.0.0.7/32", 1), ("10.0.0.0/24", 1), ("192.168.7.20/32", 0)])
def test_a_robot_in_the_network_of_a_node_needs_a_setting(address: str, count: int) -> None:
    item = fleet.well()
    item["spec"]["gate"] = {"robots": [address]}
    (_, *more) = found([identity(1)], item=item)
    assert [one.level for one in more] == ["FAIL"] * count
    assert len(found([identity(1)], {"data": {"policy-cidr-match-mode": "nodes"}}, item)) == 1
