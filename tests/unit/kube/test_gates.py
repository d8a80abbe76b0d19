"""What every kind of gate must do, and the rules of the NetworkPolicy gate."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.api.kinds.robot_workload import Gate
from understudy.kube import selectors
from understudy.kube.client import ApiError, Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord, Reach
from understudy.kube.gates.kinds.network_policy import GATE

OWNER = {"apiVersion": f"{names.GROUP}/v1alpha1", "kind": "RobotWorkload", "name": "w", "uid": "uid-w"}

every_kind = pytest.mark.parametrize("kind", registry.KINDS.values(), ids=registry.KINDS)


class Opened:
    """A gate in an API server in memory."""

    def __init__(self, kind: GateKind) -> None:
        self.kind, self.client = kind, MemoryClient()

    async def create(self, epoch: int = 0) -> None:
        await self.client.create(self.kind.resource, "fleet", self.kind.closed("w", Reach(), epoch=epoch))

    async def read(self) -> Object:
        return await self.client.get(self.kind.resource, "fleet", names.gate("w"))

    async def record(self) -> GateRecord:
        return GateRecord.of(await self.read())

    async def commit(self, active: str, over: GateRecord | None = None, **more: str) -> Object:
        uid = f"uid-{active}" if active else ""
        over = over or await self.record()
        return await self.write(self.kind.commitment("w", over=over, active=active, active_uid=uid, **more))

    async def admit(self, standby: str, over: GateRecord | None = None) -> Object:
        over = over or await self.record()
        uid = f"uid-{standby}" if standby else ""
        return await self.write(self.kind.admission("w", over=over, admitted=standby, admitted_uid=uid))

    async def write(self, patch: Object) -> Object:
        return await self.kind.write(self.client, "fleet", "w", patch)


def test_every_gate_kind_of_the_api_has_an_implementation() -> None:
    assert set(registry.KINDS) == set(get_args(Gate.model_fields["kind"].annotation))
    assert all(name == kind.kind for name, kind in registry.KINDS.items())
    assert registry.DEFAULT is registry.of({"metadata": {"name": "w"}})
    specs = [Gate.model_validate({"kind": name}) for name in registry.KINDS]
    assert [spec.is_at_robot for spec in specs] == [kind.is_at_robot for kind in registry.KINDS.values()]


@every_kind
def test_what_users_read_about_a_kind_names_its_gate_object_and_its_page(kind: GateKind) -> None:
    assert f"{kind.object_kind} w-gate" in kind.how_it_switches("w")
    assert "standby w-2" in kind.words_for_admitted("w-2")
    assert (Path(__file__).parents[3] / kind.page).is_file()


@every_kind
async def test_a_new_gate_is_closed_at_the_epoch_it_is_given(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create(epoch=41)
    record = await gate.record()
    assert (record.epoch, record.active, kind.let_through(await gate.read())) == (41, "", ())


@every_kind
async def test_a_commit_admits_exactly_one_instance(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    for epoch, active in enumerate(["a", "b", ""], start=1):
        committed = await gate.commit(active)
        assert kind.let_through(committed) == ((active,) if active else ())
        assert (GateRecord.of(committed).epoch, GateRecord.of(committed).active) == (epoch, active)


@every_kind
async def test_the_second_of_two_commits_over_the_same_record_is_refused(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    before = await gate.record()
    await gate.commit("a", over=before)
    with pytest.raises(ApiError) as refused:
        await gate.commit("b", over=before)
    assert refused.value.status == 409
    assert kind.let_through(await gate.read()) == ("a",)


@every_kind
async def test_a_standby_is_admitted_without_a_new_epoch_until_the_next_commit(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    await gate.commit("a")
    admitted = await gate.admit("b")
    assert (GateRecord.of(admitted).admitted, GateRecord.of(admitted).epoch) == ("b", 1)
    # A mux switches to the admitted standby by itself, so the gate object lets only the active one through.
    assert set(kind.let_through(admitted)) == ({"a"} if kind.kind == "Mux" else {"a", "b"})
    assert kind.let_through(await gate.admit("")) == ("a",)
    await gate.admit("b")
    committed = await gate.commit("c")
    assert (kind.let_through(committed), GateRecord.of(committed).admitted) == (("c",), "")


@every_kind
async def test_a_closed_gate_admits_no_standby(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    with pytest.raises(ValueError, match="is closed"):
        await gate.admit("b")


@every_kind
async def test_the_end_of_a_recovery_keeps_control_and_ends_the_wait_for_a_pool(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    waiting = await gate.commit("a", recovery="{}", waits_for="spare")
    assert waiting["metadata"]["labels"][names.WAITS_FOR] == "spare"
    over = GateRecord.of(waiting)
    ended = await gate.write(kind.noting(over=over, recovery="ended"))
    record = GateRecord.of(ended)
    assert (record.recovery, record.epoch, kind.let_through(ended)) == ("ended", 1, ("a",))
    assert names.WAITS_FOR not in ended["metadata"]["labels"]


@every_kind
async def test_repair_restores_owner_and_labels_and_keeps_control(kind: GateKind) -> None:
    gate = Opened(kind)
    await gate.create()
    await gate.commit("a")
    patch = kind.repair(await gate.read(), Reach(), owner=OWNER, labels={"app": "w"})
    assert patch is not None
    repaired = await gate.client.patch(kind.resource, "fleet", names.gate("w"), patch)
    assert (repaired["metadata"]["ownerReferences"], repaired["metadata"]["labels"]["app"]) == ([OWNER], "w")
    assert (GateRecord.of(repaired).active, kind.let_through(repaired)) == ("a", ("a",))
    assert kind.repair(repaired, Reach(), owner=OWNER, labels={"app": "w"}) is None


@every_kind
def test_a_monitor_may_change_only_its_own_gate(kind: GateKind) -> None:
    for rule in kind.monitor_rules("w"):
        assert "patch" not in rule["verbs"] or rule["resourceNames"] == [names.gate("w")]


OTHERS = [{"key": names.WORKLOAD, "operator": "NotIn", "values": ["w"]}]
PROTECTORS = {"podSelector": {"matchLabels": {names.MONITORED: "w"}}}
ROBOT = {"ipBlock": {"cidr": "192.168.7.0/24"}}
GATED = [{"protocol": "UDP", "port": 7950, "endPort": 8149}]


def _standby(reach: Reach) -> Object:
    ((_, found),) = GATE.companions("w", reach)
    assert found["spec"]["podSelector"] == {"matchLabels": {names.WORKLOAD: "w"}}
    spec: Object = found["spec"]
    return spec


def _ranges(rule: Object) -> list[tuple[str, int, int]]:
    return [(one["protocol"], one.get("port", 1), one.get("endPort", one.get("port", 65535))) for one in rule["ports"]]


@pytest.mark.parametrize("text", [".nan", "l\x9fÖ", "a b", "A", "a\n", "-a", "a" * 64, "{}"])
def test_a_record_with_a_name_that_no_pod_has_names_nobody(text: str) -> None:
    """A repair that puts it into a selector would be refused for ever (bench fuzz)."""
    annotations = {names.ACTIVE: text, names.ADMITTED: text, names.EPOCH: "3"}
    found = GateRecord.of({"metadata": {"annotations": annotations, "resourceVersion": "1"}})
    assert (found.epoch, found.active, found.admitted) == (3, "", "")


def test_instances_reach_pods_of_their_own_namespace_except_gated_ports_and_each_other() -> None:
    spec = _standby(Reach(robots=("192.168.7.0/24",)))
    there, names_, *more = spec["egress"]
    assert there["to"] == [{"podSelector": {"matchExpressions": OTHERS}}, ROBOT, PROTECTORS]
    assert _ranges(there) == [("TCP", 1, 65535), ("UDP", 1, 7949), ("UDP", 8150, 65535)]
    assert ("to" in names_, {port for _, port, _ in _ranges(names_)}) == (False, {53, 5353})
    assert not more


def test_only_its_monitor_reaches_the_agent_of_an_instance() -> None:
    application, protectors = _standby(Reach())["ingress"]
    assert application["from"] == [{"podSelector": {"matchExpressions": OTHERS}}]
    assert _ranges(application) == [("TCP", 1, 8949), ("TCP", 8951, 65535), ("UDP", 1, 65535)]
    assert protectors == {"from": [PROTECTORS]}


def test_the_gate_opens_the_gated_ports_of_the_same_peers_and_nothing_else() -> None:
    reach = Reach(robots=("192.168.7.0/24",))
    spec = GATE.closed("w", reach, epoch=0)["spec"]
    (rule,) = spec["egress"]
    assert (spec["policyTypes"], rule["ports"]) == (["Egress"], GATED)
    assert rule["to"] == _standby(reach)["egress"][0]["to"]


def test_peers_in_other_namespaces_never_include_instances_of_the_workload() -> None:
    peers = (
        {"namespaceSelector": {}, "podSelector": {"matchLabels": {"app": "base"}}},
        {"namespaceSelector": {"matchLabels": {"team": "robots"}}},
        {"podSelector": {"matchExpressions": [{"key": "app", "operator": "Exists"}]}},
    )
    to = _standby(Reach(peers=peers))["egress"][0]["to"]
    assert to == [
        {"namespaceSelector": {}, "podSelector": {"matchLabels": {"app": "base"}, "matchExpressions": OTHERS}},
        {"namespaceSelector": {"matchLabels": {"team": "robots"}}, "podSelector": {"matchExpressions": OTHERS}},
        {"podSelector": {"matchExpressions": [{"key": "app", "operator": "Exists"}, *OTHERS]}},
        PROTECTORS,
    ]


def test_instances_of_a_reference_without_labels_are_no_peers_of_each_other() -> None:
    reach = Reach(reference={"matchLabels": {"app": "nav", "tier": "a"}})
    (_, standby), (_, referred) = GATE.companions("w", reach)
    assert referred["spec"]["podSelector"] == {"matchLabels": {"app": "nav", "tier": "a"}}
    for spec in (standby["spec"], referred["spec"], GATE.closed("w", reach, epoch=0)["spec"]):
        *peers, protectors = spec["egress"][0]["to"]
        assert protectors == PROTECTORS
        assert [peer["podSelector"]["matchExpressions"] for peer in peers] == [
            [*OTHERS, {"key": "app", "operator": "NotIn", "values": ["nav"]}],
            [*OTHERS, {"key": "tier", "operator": "NotIn", "values": ["a"]}],
        ]


def test_instances_reach_the_api_server_if_their_agents_ask_it() -> None:
    *_, first, second = _standby(Reach(apiservers=(("10.0.0.1", 443), ("fd00::1", 6443))))["egress"]
    assert first == {"to": [{"ipBlock": {"cidr": "10.0.0.1/32"}}], "ports": [{"protocol": "TCP", "port": 443}]}
    assert second == {"to": [{"ipBlock": {"cidr": "fd00::1/128"}}], "ports": [{"protocol": "TCP", "port": 6443}]}


SELECTORS: dict[str, Object] = {
    "empty": {},
    "every-instance": {"matchLabels": {names.WORKLOAD: "w"}},
    "another-workload": {"matchLabels": {names.WORKLOAD: "v", names.INSTANCE: "a"}},
    "another-label": {"matchLabels": {names.WORKLOAD: "w", names.INSTANCE: "a", "app": "nav"}},
    "not-in": {"matchLabels": {names.WORKLOAD: "w"}, "matchExpressions": [{"key": names.INSTANCE, "operator": "NotIn", "values": ["a"]}]},
    "exists": {"matchLabels": {names.WORKLOAD: "w"}, "matchExpressions": [{"key": names.INSTANCE, "operator": "Exists"}]},
    "three": {
        "matchLabels": {names.WORKLOAD: "w"},
        "matchExpressions": [{"key": names.INSTANCE, "operator": "In", "values": ["a", "b", "c"]}],
    },
    "without-the-workload": {"matchExpressions": [{"key": names.INSTANCE, "operator": "In", "values": ["a", "b"]}]},
}  # fmt: skip


@pytest.mark.parametrize("selector", SELECTORS.values(), ids=SELECTORS)
@pytest.mark.parametrize(("active", "admitted"), [("", ""), ("a", ""), ("a", "b")], ids=["closed", "one", "two"])
async def test_a_selector_that_no_commit_writes_is_restored_from_the_record(
    active: str, admitted: str, selector: Object
) -> None:
    gate = Opened(GATE)
    await gate.create()
    before = await gate.commit(active)
    if admitted:
        before = await gate.admit(admitted)
    edited = {**before, "spec": {**before["spec"], "podSelector": selector, "egress": []}}
    patch = GATE.repair(edited, Reach(), owner=OWNER, labels={})
    assert patch is not None
    gate.client.store(GATE.resource, "fleet", edited)
    repaired = await gate.write(patch)
    assert repaired["spec"] == before["spec"]
    assert repaired["metadata"]["annotations"] == before["metadata"]["annotations"]
    assert GATE.repair(repaired, Reach(), owner=OWNER, labels={}) is None
    assert GATE.let_through(repaired) == tuple(name for name in (active, admitted) if name)


@pytest.mark.parametrize("through", [("", ""), ("b", ""), ("a", "b")])
async def test_whom_a_gate_lets_through_is_restored_from_its_record_although_no_monitor_runs(
    through: tuple[str, str],
) -> None:
    """A commit writes both at once. Somebody let a standby through, and its monitor had just been killed: it drove for 14 s."""
    gate = Opened(GATE)
    await gate.create()
    before = await gate.commit("a")
    edited = {**before, "spec": {**before["spec"], **GATE.routing("w", *through)["spec"]}}
    assert "spec" not in (GATE.repair(edited, Reach(), owner=OWNER, labels={}, paused=True) or {})
    patch = GATE.repair(edited, Reach(), owner=OWNER, labels={})
    assert patch is not None
    gate.client.store(GATE.resource, "fleet", edited)
    assert (await gate.write(patch))["spec"] == before["spec"]


def test_a_record_that_names_a_standby_and_nobody_in_control_lets_nobody_through() -> None:
    gate = GATE.closed("w", Reach(), epoch=3)
    gate["metadata"] |= {"resourceVersion": "1"}
    gate["metadata"]["annotations"] |= {names.ADMITTED: "b", names.ADMITTED_UID: "uid-b"}
    gate["spec"]["podSelector"] = {}
    patch = GATE.repair(gate, Reach(), owner=OWNER, labels={})
    assert patch is not None
    assert patch["spec"] == GATE.routing("w", "")["spec"]


UNCLAIMED = {names.WORKLOAD: names.UNCLAIMED, names.HELD: "true", names.POOL: "spare", names.INSTANCE: "a"}


@pytest.mark.parametrize("labels", [UNCLAIMED, {names.WORKLOAD: "w", names.INSTANCE: "a"}], ids=["before", "after"])
@pytest.mark.parametrize("through", [("a", ""), ("a", "b"), ("b", "a")])
async def test_a_gate_lets_a_claimed_pod_through_by_its_labels_from_before_its_claim_and_from_after_it(
    labels: Object, through: tuple[str, str]
) -> None:
    """A network may read the changed labels of a pod late: Cilium after 6 to 30 s."""
    gate = Opened(GATE)
    await gate.create()
    assert not selectors.matches((await gate.read())["spec"]["podSelector"], labels)
    await gate.write(GATE.routing("w", *through))
    selector = (await gate.read())["spec"]["podSelector"]
    assert selectors.matches(selector, labels)
    assert not selectors.matches(selector, labels | {names.INSTANCE: "c"})
    assert not selectors.matches(selector, labels | {names.WORKLOAD: "v"}), "an instance of another workload"


@pytest.mark.parametrize(
    ("selector", "admitted"),
    [
        ({"matchLabels": {names.WORKLOAD: "w", names.INSTANCE: "a"}}, ""),
        (
            {
                "matchLabels": {names.WORKLOAD: "w"},
                "matchExpressions": [{"key": names.INSTANCE, "operator": "In", "values": ["a", "b"]}],
            },
            "b",
        ),
    ],
    ids=["one", "two"],
)
async def test_a_selector_that_a_monitor_of_an_earlier_version_has_written_is_right(
    selector: Object, admitted: str
) -> None:
    """It would write it again, and operator and monitor would take turns."""
    gate = Opened(GATE)
    await gate.create()
    before = await gate.commit("a")
    if admitted:
        before = await gate.admit(admitted)
    earlier = {**before, "spec": {**before["spec"], "podSelector": selector}}
    assert GATE.let_through(earlier) == GATE.let_through(before)
    assert not GATE.routing_repair(earlier, "w", "a", admitted)
    assert GATE.routing_repair(earlier, "w", "b", admitted)


def test_an_epoch_that_somebody_lowered_is_restored_to_the_last_reported_one() -> None:
    """Agents would refuse the monitor otherwise: they know a newer epoch."""
    gate = GATE.closed("w", Reach(), epoch=3)
    gate["metadata"] |= {"resourceVersion": "1", "ownerReferences": [OWNER]}
    patch = GATE.repair(gate, Reach(), owner=OWNER, labels={}, epoch=7)
    assert patch == {"metadata": {"annotations": {names.EPOCH: "7"}}}
    assert GATE.repair(gate, Reach(), owner=OWNER, labels={}, epoch=3) is None


@pytest.mark.parametrize("text", ["²", "9" * 5000, "-1", "soon", ""])
def test_an_epoch_that_is_no_number_counts_as_none(text: str) -> None:
    gate = GATE.closed("w", Reach(), epoch=3)
    gate["metadata"] |= {"resourceVersion": "1"}
    gate["metadata"]["annotations"] |= {names.EPOCH: text, names.FENCED: text}
    record = GateRecord.of(gate)
    assert (record.epoch, record.fenced) == (0, 0)


@pytest.mark.parametrize("wrong", [{"egress": []}, {"egress": [{}]}, {"policyTypes": ["Ingress"]}, {"ingress": [{}]}])
def test_rules_that_somebody_changed_are_restored(wrong: Object) -> None:
    gate = GATE.closed("w", Reach(), epoch=0)
    gate["metadata"] |= {"resourceVersion": "1"}
    gate["spec"] |= wrong
    patch = GATE.repair(gate, Reach(), owner=OWNER, labels={})
    assert patch is not None
    right = GATE.closed("w", Reach(), epoch=0)["spec"]
    assert patch["spec"] == {"policyTypes": ["Egress"], "egress": right["egress"], "ingress": None}
