"""What the account of a compromised monitor cannot do with its gate, and what a correct monitor must be able to do.

All is asked of a real API server.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import pytest

from tests.cluster.monitor_accounts import ACTIVE, MINE, OTHER, OWNER, STANDBY, refusal, until_refused
from tests.cluster.operators import NETWORK, Fleet, Operator, policy, workload
from tests.support.cluster import Cluster, Object, Refused, until
from understudy.api import names
from understudy.kube.client import NETWORK_POLICIES, ApiError, Client
from understudy.kube.gates import pool_pod_policies
from understudy.kube.gates.base import GateRecord, Reach
from understudy.kube.gates.kinds.network_policy import GATE


def _selecting(*, workload: str = MINE, instance: str | None = None, **expression: object) -> Object:
    """A selector in place of the gate's."""
    labels = {names.WORKLOAD: workload, names.INSTANCE: instance}
    return {"podSelector": {"matchLabels": labels, "matchExpressions": [expression] if expression else None}}


def _record(**values: str | None) -> Object:
    return {"metadata": {"annotations": {f"{names.GROUP}/{key.replace('_', '-')}": v for key, v in values.items()}}}


def _requiring(workloads: Sequence[str], instances: Sequence[str], operator: str = "In") -> Object:
    """A selector of the form that a monitor writes, in place of the gate's."""
    requirements = [
        {"key": names.WORKLOAD, "operator": "In", "values": list(workloads)},
        {"key": names.INSTANCE, "operator": operator, "values": list(instances)},
    ]
    return {"podSelector": {"matchLabels": None, "matchExpressions": requirements}}


SELECTORS: dict[str, Object] = {
    "requires-another-workload": _requiring([OTHER, names.UNCLAIMED], [ACTIVE]),
    "requires-one-of-two-workloads": _requiring([MINE, names.UNCLAIMED, OTHER], [ACTIVE]),
    "requires-another-than-the-record-names": _requiring([MINE, names.UNCLAIMED], [STANDBY]),
    "requires-one-of-three": _requiring([MINE, names.UNCLAIMED], [ACTIVE, STANDBY, "robot-17-c"]),
    "requires-not-the-active-one": _requiring([MINE, names.UNCLAIMED], [ACTIVE], operator="NotIn"),
    "requires-nobody": _requiring([MINE, names.UNCLAIMED], [names.NOBODY]),
    "every-pod-of-the-namespace": {"podSelector": {"matchLabels": None, "matchExpressions": None}},
    "every-instance": _selecting(),
    "another-workload": _selecting(workload=OTHER, instance=ACTIVE),
    "not-the-active-one": _selecting(key=names.INSTANCE, operator="NotIn", values=[ACTIVE]),
    "any-instance": _selecting(key=names.INSTANCE, operator="Exists"),
    "three-instances": _selecting(key=names.INSTANCE, operator="In", values=[ACTIVE, STANDBY, "robot-17-c"]),
    "two-that-the-record-does-not-name": _selecting(key=names.INSTANCE, operator="In", values=[ACTIVE, STANDBY]),
    "by-another-label": _selecting(key="app", operator="In", values=["nav"]),
    "another-than-the-record-names": _selecting(instance=STANDBY),
    "closed-but-not-by-the-record": _selecting(instance=names.NOBODY),
    "with-another-label": {"podSelector": {"matchLabels": {"app": "nav"}, "matchExpressions": None}},
    "with-another-requirement": _selecting(instance=ACTIVE, key="app", operator="Exists"),
}


@pytest.mark.parametrize("selector", SELECTORS.values(), ids=SELECTORS)
def test_a_gate_lets_through_only_whom_its_record_names(
    cluster: Cluster, compromised_monitor: str, gate: Object, selector: Object
) -> None:
    assert "may let through only the instances that the gate's record names" in refusal(
        lambda: cluster.patch(gate, {"spec": selector}, user=compromised_monitor)
    )
    live = cluster.get(NETWORK, "NetworkPolicy", names.gate(MINE), gate["metadata"]["namespace"])
    assert live["spec"] == gate["spec"]


@pytest.mark.parametrize(
    "more",
    [
        {"active": "", "active_uid": ""},
        {"active": STANDBY, "active_uid": "uid-b"},
        {"admitted": STANDBY, "admitted_uid": "uid-b"},
    ],
    ids=["closed", "another", "admitted"],
)
def test_a_record_names_only_whom_its_gate_lets_through(
    cluster: Cluster, compromised_monitor: str, gate: Object, more: dict[str, str]
) -> None:
    assert "may let through only the instances that the gate's record names" in refusal(
        lambda: cluster.patch(gate, _record(epoch="8", **more), user=compromised_monitor)
    )


def test_a_closed_gate_admits_no_standby(cluster: Cluster, compromised_monitor: str, gate: Object) -> None:
    record = _record(epoch="8", active="", active_uid="", admitted=STANDBY, admitted_uid="uid-b")
    for selector in (
        _selecting(instance=STANDBY),
        _selecting(key=names.INSTANCE, operator="In", values=["", STANDBY]),
        _selecting(key=names.INSTANCE, operator="In", values=[STANDBY]),
        _selecting(instance=names.NOBODY),
    ):
        assert "may let through only" in refusal(
            lambda selector=selector: cluster.patch(gate, {**record, "spec": selector}, user=compromised_monitor)  # type: ignore[misc]
        )


@pytest.mark.parametrize(
    "rules",
    [
        {"egress": [{"to": [{"ipBlock": {"cidr": "0.0.0.0/0"}}]}]},
        {"egress": []},
        {"policyTypes": ["Egress", "Ingress"]},
        {"policyTypes": ["Ingress", "Egress"], "ingress": [{}]},
    ],
    ids=["egress", "no-egress", "types", "ingress"],
)
def test_the_rules_of_a_gate_stay(cluster: Cluster, compromised_monitor: str, gate: Object, rules: Object) -> None:
    assert "of its gate only" in refusal(lambda: cluster.patch(gate, {"spec": rules}, user=compromised_monitor))


@pytest.mark.parametrize(
    "metadata",
    [
        {"labels": {"app.kubernetes.io/managed-by": None}},
        {"labels": {names.WORKLOAD: MINE}},
        {"annotations": {"understudy.dev/applied": "0"}},
        {"annotations": {"kubectl.kubernetes.io/last-applied-configuration": "{}"}},
        {"ownerReferences": []},
        {"ownerReferences": [OWNER | {"uid": "uid-v"}]},
        {"finalizers": ["example.com/stay"]},
    ],
    ids=["label-removed", "label-added", "our-annotation", "annotation", "no-owner", "other-owner", "finalizer"],
)
def test_a_monitor_writes_the_record_of_its_gate_and_nothing_else(
    cluster: Cluster, compromised_monitor: str, gate: Object, metadata: Object
) -> None:
    assert "of its gate only" in refusal(lambda: cluster.patch(gate, {"metadata": metadata}, user=compromised_monitor))


EPOCHS = ["6", "", None, "9", "99999999999999999999", "9" * 5000, "-1", "²", "8 ", "0x8", "08"]


@pytest.mark.parametrize("epoch", EPOCHS, ids=[str(epoch)[:20] for epoch in EPOCHS])
def test_the_epoch_grows_by_one_with_each_commit_and_never_falls(
    cluster: Cluster, compromised_monitor: str, gate: Object, epoch: str | None
) -> None:
    commit = GATE.commitment(MINE, over=GateRecord.of(gate), active=STANDBY, active_uid="uid-b")
    commit["metadata"]["annotations"][names.EPOCH] = epoch
    assert "must increase the epoch" in refusal(lambda: cluster.patch(gate, commit, user=compromised_monitor))
    only = {"metadata": {"annotations": {names.EPOCH: epoch}}}
    assert "must increase the epoch" in refusal(lambda: cluster.patch(gate, only, user=compromised_monitor))


def test_control_does_not_move_without_a_new_epoch(cluster: Cluster, compromised_monitor: str, gate: Object) -> None:
    commit = GATE.commitment(MINE, over=GateRecord.of(gate), active=STANDBY, active_uid="uid-b")
    del commit["metadata"]["annotations"][names.EPOCH]
    assert "must increase the epoch" in refusal(lambda: cluster.patch(gate, commit, user=compromised_monitor))
    assert "must increase the epoch" in refusal(
        lambda: cluster.patch(gate, _record(active_uid="uid-twin"), user=compromised_monitor)
    )


def test_a_monitor_does_not_touch_the_mark_of_a_user_who_fenced(
    cluster: Cluster, compromised_monitor: str, gate: Object
) -> None:
    assert "may remove the annotation understudy.dev/fenced only" in refusal(
        lambda: cluster.patch(gate, _record(fenced="3"), user=compromised_monitor)
    )
    closed = cluster.patch(gate, GATE.commitment(MINE, over=GateRecord.of(gate), fenced=3))
    for value in (None, "0", "2"):
        assert "may remove the annotation understudy.dev/fenced only" in refusal(
            lambda value=value: cluster.patch(closed, _record(fenced=value), user=compromised_monitor)  # type: ignore[misc]
        )
    kept = cluster.patch(closed, GATE.commitment(MINE, over=GateRecord.of(closed)), user=compromised_monitor)
    assert GateRecord.of(kept).fenced == 3
    opened = GATE.commitment(MINE, over=GateRecord.of(kept), active=ACTIVE, active_uid="uid-a")
    assert GateRecord.of(cluster.patch(kept, opened, user=compromised_monitor)).fenced == 0


def _may_patch_all_policies(cluster: Cluster, namespace: str, user: str) -> None:
    group, name = "rbac.authorization.k8s.io", "too-much"
    role: Object = {"apiVersion": f"{group}/v1", "kind": "Role", "metadata": {"name": name}}
    rules = [{"apiGroups": ["networking.k8s.io"], "resources": ["networkpolicies"], "verbs": ["patch"]}]
    cluster.create({**role, "rules": rules}, namespace)
    subject = {"kind": "User", "name": user, "apiGroup": group}
    reference = {"apiGroup": group, "kind": "Role", "name": name}
    cluster.create({**role, "kind": "RoleBinding", "roleRef": reference, "subjects": [subject]}, namespace)


def test_a_monitor_writes_no_other_policy_whatever_its_role_says(
    cluster: Cluster, namespace: str, compromised_monitor: str
) -> None:
    ((_, standby),) = GATE.companions(MINE, Reach())
    others = [cluster.create(GATE.closed(OTHER, Reach(), epoch=7), namespace), cluster.create(standby, namespace)]
    body = _record(overtaken="r")
    for other in others:
        assert "cannot patch resource" in refusal(
            lambda other=other: cluster.patch(other, body, user=compromised_monitor)
        )  # type: ignore[misc]
    _may_patch_all_policies(cluster, namespace, compromised_monitor)

    def judged() -> bool:
        return "may change the gate of its own workload only" in refusal(
            lambda: cluster.patch(others[0], body, user=compromised_monitor)
        )

    until(judged, "the additional right to count")
    assert "may change the gate of its own workload only" in refusal(
        lambda: cluster.patch(others[1], body, user=compromised_monitor)
    )


@pytest.fixture
def claimed(cluster: Cluster, namespace: str, compromised_monitor: str) -> Object:
    """The policy of the pods that the workload has claimed, once its admission policy is enforced."""
    rules = GATE.instance_rules(MINE, Reach())
    made = cluster.create(pool_pod_policies.claimed_pods(MINE, rules, []), namespace)
    until_refused(
        lambda: cluster.patch(
            made, {"metadata": {"labels": {"effective": "no"}}}, user=compromised_monitor, dry_run=True
        ),
        "may change only which pods",
        "the admission policy of claimed pods to be enforced",
    )
    return made


async def test_a_correct_monitor_names_claimed_pods(
    correct_monitor: Client, cluster: Cluster, namespace: str, claimed: Object
) -> None:
    selector = pool_pod_policies.claimed_selector(MINE, ["spare-1", "spare-2"])
    body = {"spec": {"podSelector": selector}}
    made = await correct_monitor.patch(NETWORK_POLICIES, namespace, names.claimed(MINE), body)
    assert made["spec"] == claimed["spec"] | {"podSelector": selector}


@pytest.mark.parametrize(
    "spec",
    [
        {"egress": [{}]},
        {"ingress": [{}]},
        {"policyTypes": ["Egress"]},
        _requiring([OTHER, names.UNCLAIMED], [ACTIVE]),
        _requiring([MINE, names.UNCLAIMED, OTHER], [ACTIVE]),
        _requiring([MINE, names.UNCLAIMED], [ACTIVE], operator="NotIn"),
        {"podSelector": {"matchExpressions": None}},
        {"podSelector": {"matchLabels": {"app": "nav"}}},
    ],
    ids=["egress", "ingress", "types", "other", "another", "not-in", "everybody", "label"],
)
def test_a_monitor_lets_the_policy_of_claimed_pods_select_no_pods_of_others(
    cluster: Cluster, compromised_monitor: str, claimed: Object, spec: Object
) -> None:
    message = refusal(lambda: cluster.patch(claimed, {"spec": spec}, user=compromised_monitor))
    assert "may select only pods of its own workload" in message or "may change only which pods" in message


def test_everybody_else_writes_gates_as_their_roles_allow(
    cluster: Cluster, namespace: str, compromised_monitor: str, gate: Object
) -> None:
    person = "person@example.com"
    _may_patch_all_policies(cluster, namespace, person)

    def written() -> bool:
        try:
            cluster.patch(gate, {"metadata": {"labels": {"team": "blue"}}}, user=person)
        except Refused:
            return False
        return True

    until(written, "the person's rights to count")


# -- without the admission policies ---------------------------------------------------------------------------------------


def test_the_operator_restores_a_gate_that_somebody_opened_for_further_pods(fleet: Fleet, operator: Operator) -> None:
    """No monitor runs here, so nobody else restores it."""
    fleet.create(policy("Restart"), workload())
    gate = until(lambda: fleet.find("NetworkPolicy", names.gate("w"), NETWORK), "the gate")
    commit = GATE.commitment("w", over=GateRecord.of(gate), active="w-a", active_uid="uid-a")
    committed = fleet.cluster.patch(gate, commit)["spec"]
    selector, rules = committed["podSelector"], committed["egress"]
    for edit in (
        {"podSelector": {"matchExpressions": None}},
        {"podSelector": {"matchExpressions": [{"key": names.WORKLOAD, "operator": "In", "values": ["w"]}]}},
        {"podSelector": {"matchLabels": {names.WORKLOAD: "v"}}, "egress": []},
    ):
        fleet.cluster.patch(gate, {"spec": edit})
        until(lambda: fleet.gate()["spec"]["podSelector"] == selector, f"the selector after {edit}", seconds=10)
    until(lambda: fleet.gate()["spec"]["egress"] == rules, "the rules", seconds=10)
    assert GateRecord.of(fleet.gate()).epoch == 1


def test_the_repair_of_a_gate_never_undoes_a_commit(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), workload())
    gate = until(lambda: fleet.find("NetworkPolicy", names.gate("w"), NETWORK), "the gate")
    rounds = 20
    for number in range(rounds):
        fleet.cluster.patch(gate, {"spec": {"podSelector": {"matchExpressions": None}}})

        def committed(number: int = number) -> bool:
            over = GateRecord.of(fleet.gate())
            try:
                fleet.cluster.patch(
                    gate, GATE.commitment("w", over=over, active=f"w-{number}", active_uid=f"uid-{number}")
                )
            except Refused as error:
                if error.status != 409:
                    raise
                return False
            return True

        until(committed, "a commit")
        time.sleep(0.02 * (number % 4))
        found = fleet.gate()
        assert (GATE.let_through(found), GateRecord.of(found).active) == ((f"w-{number}",), f"w-{number}")
    assert GateRecord.of(fleet.gate()).epoch == rounds


# -- what a correct monitor writes ----------------------------------------------------------------------------------------


async def test_a_correct_monitor_commits_and_records_at_its_gate(
    correct_monitor: Client, cluster: Cluster, namespace: str, gate: Object
) -> None:
    async def write(patch: Object) -> Object:
        return await GATE.write(correct_monitor, namespace, MINE, patch)

    def commitment(over: Object, **more: str) -> Object:
        return GATE.commitment(MINE, over=GateRecord.of(over), **more)

    closed = await write(commitment(gate, recovery='{"id": "r"}', waits_for="spare", let_through="[]"))
    assert (GATE.let_through(closed), closed["metadata"]["labels"][names.WAITS_FOR]) == ((), "spare")
    opened = await write(
        commitment(closed, active=STANDBY, active_uid="uid-b", recovery="{}", let_through='[{"a": 1}]')
    )
    assert (GateRecord.of(opened).epoch, GATE.let_through(opened)) == (9, (STANDBY,))
    ended = await write(GATE.noting(over=GateRecord.of(opened), recovery='{"result": "Recovered"}'))
    overtaken = await write(GATE.overtaking(over=GateRecord.of(ended), recovery="r"))
    with pytest.raises(ApiError) as refused:
        await write(commitment(ended, active=ACTIVE, active_uid="uid-a"))
    assert refused.value.conflict, "the commit that was overtaken is no longer carried out"
    both = await write(
        GATE.admission(MINE, over=GateRecord.of(overtaken), admitted=ACTIVE, admitted_uid="uid-a", let_through="[]")
    )
    assert GATE.let_through(both) == (STANDBY, ACTIVE)
    without = await write(GATE.admission(MINE, over=GateRecord.of(both), admitted="", admitted_uid=""))
    again = await write(GATE.admission(MINE, over=GateRecord.of(without), admitted=ACTIVE, admitted_uid="uid-a"))
    switched = await write(commitment(again, active=ACTIVE, active_uid="uid-a"))
    assert GATE.let_through(switched) == (ACTIVE,)
    await write(commitment(switched))


@pytest.mark.parametrize("admitted", ["", STANDBY], ids=["one", "two"])
async def test_a_correct_monitor_repairs_its_gate_after_an_edit(
    correct_monitor: Client, cluster: Cluster, namespace: str, gate: Object, admitted: str
) -> None:
    if admitted:
        patch = GATE.admission(MINE, over=GateRecord.of(gate), admitted=admitted, admitted_uid="uid-b")
        gate = await GATE.write(correct_monitor, namespace, MINE, patch)
    for edit in (*SELECTORS.values(), {"egress": [], **SELECTORS["every-pod-of-the-namespace"]}):
        edited = cluster.patch(gate, {"spec": edit})
        # Its other writes do not wait for the repair.
        edited = await GATE.write(
            correct_monitor,
            namespace,
            MINE,
            GATE.overtaking(over=GateRecord.of(edited), recovery=f"r{edited['metadata']['generation']}"),
        )
        fields = GATE.routing_repair(edited, MINE, ACTIVE, admitted)
        if not fields:  # the edit was no change
            continue
        fields = {"metadata": {"resourceVersion": edited["metadata"]["resourceVersion"]}} | fields
        repaired = await GATE.write(correct_monitor, namespace, MINE, fields)
        assert repaired["spec"]["podSelector"] == gate["spec"]["podSelector"]


@pytest.mark.parametrize("edit", SELECTORS.values(), ids=SELECTORS)
async def test_a_correct_monitor_commits_over_a_selector_that_somebody_edited(
    correct_monitor: Client, cluster: Cluster, namespace: str, gate: Object, edit: Object
) -> None:
    for active, uid in (("", ""), (STANDBY, "uid-b")):
        edited = cluster.patch(gate, {"spec": edit})
        commit = GATE.commitment(MINE, over=GateRecord.of(edited), active=active, active_uid=uid)
        assert set(GATE.let_through(await GATE.write(correct_monitor, namespace, MINE, commit))) <= {active}
    edited = cluster.patch(gate, {"spec": edit})
    both = GATE.admission(MINE, over=GateRecord.of(edited), admitted=ACTIVE, admitted_uid="uid-a")
    assert GATE.let_through(await GATE.write(correct_monitor, namespace, MINE, both)) == (STANDBY, ACTIVE)


async def test_a_correct_monitor_commits_over_a_record_that_somebody_damaged(
    correct_monitor: Client, cluster: Cluster, namespace: str, gate: Object
) -> None:
    for damage in ({"epoch": None}, {"epoch": "²"}, {"epoch": "soon", "active": None, "active_uid": None}):
        damaged = cluster.patch(gate, _record(**damage))
        commit = GATE.commitment(MINE, over=GateRecord.of(damaged), active=STANDBY, active_uid="uid-b")
        assert GateRecord.of(await GATE.write(correct_monitor, namespace, MINE, commit)).epoch == 1
