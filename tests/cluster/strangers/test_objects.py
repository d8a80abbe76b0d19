"""Objects of tenants that are made to stop the operator: deeply nested values, and trees whose check takes long."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from tests.cluster.operators import Fleet, Operator, custom, leader, policy, process, workload
from tests.support.cluster import Object, until
from tests.support.nested_values import PLACE, text

LEAVES = "".join(f"        node('/{'a' * 40}{index}')\n" for index in range(510))

VALUE = f"a: [{', '.join('1' for _ in range(5000))}]"
USES = '<SubTree ID="b"/>' * 60
REPEATED = (
    f'<root BTCPP_format="4" main_tree_to_execute="a"><BehaviorTree ID="a"><Sequence>{USES}</Sequence></BehaviorTree>'
    f'<BehaviorTree ID="b"><CallService service="/a" type="a/srv/B" request="{VALUE}" expect="{VALUE}"/></BehaviorTree></root>'
)
"""A text of 30 kB whose values have 1.8 million characters."""


def costly(index: int) -> Object:
    tree = {"osc": f"import osc.understudy\nscenario healthy{index}:\n    do parallel:\n{LEAVES}"}
    recovery = {"xml": REPEATED.replace("/a", f"/a{index}"), "within": "10s"}
    spec = {"monitoring": tree, "strategies": [{"type": "Restart", "recovery": recovery}]}
    return custom("FailurePolicy", f"costly{index}", spec)


def reason(fleet: Fleet, name: str) -> str:
    found: str = fleet.condition("FailurePolicy", name, "Accepted").get("reason", "")
    return found


def test_costly_trees_do_not_cost_the_operator_its_lease(fleet: Fleet) -> None:
    with process(fleet, "one") as one:
        until(lambda: leader(fleet) == "one", "the operator to lead", seconds=60)
        for index in range(8):
            fleet.create(costly(index))
        fleet.create(policy("Restart"))
        until(lambda: reason(fleet, "policy") == "Accepted", "the policy behind them to be accepted", seconds=240)
        for index in range(8):
            until(lambda index=index: reason(fleet, f"costly{index}") == "TreeInvalid", "its refusal", seconds=240)
            message = fleet.condition("FailurePolicy", f"costly{index}", "Accepted")["message"]
            assert "the values of the tree have more than" in message
        lease = fleet.get("Lease", "understudy-operator", "coordination.k8s.io/v1")["spec"]
        assert (lease["holderIdentity"], lease.get("leaseTransitions") or 0) == ("one", 0)
        assert one.poll() is None


@pytest.mark.parametrize("levels", [150, 700, 1500])
def test_an_object_with_deeply_nested_values_is_refused_and_all_others_are_followed(
    levels: int, fleet: Fleet, operator: Operator, tmp_path: Path
) -> None:
    """The API server stores it: neither a schema nor CEL limits how deeply unknown content is nested."""
    file = tmp_path / "deep.json"
    file.write_text(text(policy("Restart", name="deep", yaml={"sequence": PLACE}), levels))
    kubectl = partial(fleet.cluster.kubectl, "--namespace", fleet.namespace)  # Go decodes what Python does not
    kubectl("create", "-f", str(file))
    accepted = "jsonpath={.status.conditions[?(@.type=='Accepted')]['reason', 'message']}"
    found = until(lambda: kubectl("get", "failurepolicy", "deep", "-o", accepted), "the condition Accepted")
    assert found.startswith("SpecInvalid spec.monitoring.yaml: ")
    fleet.create(policy("Restart"), workload())
    fleet.wait_condition("RobotWorkload", "w", "Accepted", "Accepted", "True")
    kubectl(
        "patch", "failurepolicy", "deep", "--type=merge", "-p", '{"spec":{"monitoring":{"yaml":null,"xml":"<root/>"}}}'
    )
    until(lambda: kubectl("get", "failurepolicy", "deep", "-o", accepted).startswith("TreeInvalid"), "the correction")


def test_a_text_with_any_character_is_quoted_in_a_condition(fleet: Fleet, operator: Operator) -> None:
    """The API server reads what the operator applies as YAML, which takes fewer characters than JSON."""
    tree = {"age": {"topic": "/scan", "by": "\U0001f6a7\x7f\x85\u2028\ufeff\uffff"}}
    fleet.create(policy("Restart", name="strange", yaml=tree))
    until(lambda: reason(fleet, "strange") == "TreeInvalid", "its verdict")
    assert "\U0001f6a7" in fleet.condition("FailurePolicy", "strange", "Accepted")["message"]
