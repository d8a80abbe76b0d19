"""Trees whose check takes long do not cost the operator its lease."""

from __future__ import annotations

from tests.cluster.operators import Fleet, custom, leader, policy, process
from tests.support.cluster import Object, until

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
