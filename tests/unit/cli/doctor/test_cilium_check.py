"""What doctor finds on Cilium, whose policy maps are limited."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.cilium import EACH, NAME, identity, policies
from tests.support.golden import assert_golden
from tests.unit.cli.doctor.server import Server
from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Refused
from understudy.cli.doctor import cilium_check
from understudy.cli.doctor.findings import Finding
from understudy.kube.client import CONFIG_MAPS, NETWORK_POLICIES, NODES, Object
from understudy.kube.gates import cilium
from understudy.kube.gates.base import Reach


def found(
    identities: Any, settings: Any = None, item: Object | None = None, mine: list[Object] | None = None
) -> list[Finding]:
    answers = {
        cilium.IDENTITIES.path(None): {"items": identities} if isinstance(identities, list) else identities,
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
    elsewhere = identity(17, namespace="other")
    own = identity(1, **{names.WORKLOAD: NAME})
    many = [*(identity(number) for number in range(1000)), elsewhere, own]
    (finding,) = found(many, mine=policies(Reach(peers=(robot,))))
    assert (finding.level, f"needs {EACH} entries" in finding.found) == ("OK", True)


def test_the_settings_need_not_be_readable() -> None:
    (finding,) = found([identity(1)], Refused(403, "forbidden"))
    assert "of 16384" in finding.found


def test_a_size_of_the_maps_that_is_no_number_is_reported_and_the_default_assumed() -> None:
    wrong, room = found([identity(1)], {"data": {"bpf-policy-map-max": "many"}})
    assert (wrong.check, wrong.level, room.level) == ("settings of Cilium", "WARN", "OK")
    assert_golden("doctor", f"{wrong.found}; {wrong.cure}", "bpf-policy-map-max", "'many'", "kube-system/cilium-config")
    assert_golden("doctor", room.found, "of 16384")


@pytest.mark.parametrize(("address", "count"), [("10.0.0.7/32", 1), ("10.0.0.0/24", 1), ("192.168.7.20/32", 0)])
def test_a_robot_in_the_network_of_a_node_needs_a_setting(address: str, count: int) -> None:
    item = fleet.well()
    item["spec"]["gate"] = {"robots": [address]}
    (_, *more) = found([identity(1)], item=item)
    assert [one.level for one in more] == ["FAIL"] * count
    assert len(found([identity(1)], {"data": {"policy-cidr-match-mode": "nodes"}}, item)) == 1
