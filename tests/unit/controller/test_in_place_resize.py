"""What the pod in control is given while its workload is degraded: raised, never lowered, and told."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.controller.world import World, gate, policy, source_pod, workload
from understudy.api.kinds.degraded_spec import Resize
from understudy.api.quantities import amount
from understudy.controller.plan import Patch, Problem
from understudy.controller.reconcile import in_place_resize
from understudy.controller.reconcile.in_place_resize import ResizeOutcome
from understudy.kube.client import STRATEGIC, Object

SLOW = {"requests": {"cpu": "50m"}, "limits": {"cpu": "200m", "memory": "256Mi"}}


def running(name: str = "w-a", resources: Object | None = None, **container: Any) -> Object:
    """The pod in control as the API server has it."""
    made = source_pod(name)
    given_ = SLOW if resources is None else resources
    app = {"name": "app", "resources": given_, **container}
    agent = {"name": "understudy-agent", "resources": {"requests": {"cpu": "20m"}}}
    made["spec"] = {"containers": [app, agent]}
    made["status"]["containerStatuses"] = [{"name": "app", "resources": given_}]
    return made


def world(*actions: Object, pod: Object | None = None) -> World:
    made = World(workload(), asking(*actions))
    made.resized = pod if pod is not None else running()
    return made


def asking(*actions: Object) -> Object:
    made = policy("Restart")
    tree = {"topic": {"name": "/cmd_vel", "rate": "> 18 Hz"}}
    made["spec"]["degraded"] = {"monitoring": {"yaml": tree}, "actions": list(actions)}
    return made


def outcomes(made: World) -> list[ResizeOutcome]:
    return in_place_resize.outcomes(made.observed(), made.understood())


def only(made: World) -> ResizeOutcome:
    (found,) = outcomes(made)
    return found


MORE: Object = {"resize": {"cpu": "1500m"}}


def test_request_and_existing_limit_of_the_first_container_are_raised() -> None:
    found = only(world(MORE))
    assert found.reason == "InProgress"
    assert isinstance(found.write, Patch)
    assert (found.write.subresource, found.write.kind) == ("resize", STRATEGIC)
    resources = {"requests": {"cpu": "1500m"}, "limits": {"cpu": "1500m"}}
    assert found.write.body == {
        "metadata": {"uid": "uid-w-a"},
        "spec": {"containers": [{"name": "app", "resources": resources}]},
    }


def test_a_container_can_be_selected_by_name_and_both_resources_can_be_raised() -> None:
    made = world({"resize": {"container": "understudy-agent", "cpu": "40m", "memory": "128Mi"}})
    write = only(made).write
    assert write is not None
    assert write.body["spec"]["containers"] == [
        {"name": "understudy-agent", "resources": {"requests": {"cpu": "40m", "memory": "128Mi"}}}
    ]


def test_a_container_that_has_enough_is_not_resized_and_is_reported_as_resized() -> None:
    enough = {"requests": {"cpu": "1.5"}, "limits": {"cpu": "4"}}
    made = world(MORE, pod=running(resources=enough))
    found = only(made)
    assert found.write is None
    status = in_place_resize.judged([found])
    assert status is not None
    assert (status.status, status.reason) == ("True", "Resized")
    assert status.message == "container app of pod w-a has cpu 1500m."


def test_nothing_is_resized_without_degradation_or_with_an_invalid_policy() -> None:
    made = world(MORE)
    made.resized = None
    assert outcomes(made) == []
    assert in_place_resize.judged([]) is None
    made = world(MORE)
    made.others[0]["spec"]["degraded"]["monitoring"]["yaml"] = {"topik": {}}
    assert outcomes(made) == []


def test_an_unknown_container_is_reported_with_the_existing_ones() -> None:
    found = only(world({"resize": {"container": "ap", "cpu": "1"}}))
    assert (found.reason, found.write) == ("ContainerNotFound", None)
    assert_golden(
        "operator",
        found.message,
        "FailurePolicy",
        "spec.degraded.actions[0].resize.container",
        "pod w-a",
        '"ap"',
        '"app"',
    )


def test_a_container_that_would_restart_is_not_resized() -> None:
    policies = [{"resourceName": "cpu", "restartPolicy": "RestartContainer"}]
    found = only(world(MORE, pod=running(resizePolicy=policies)))
    assert (found.reason, found.write) == ("WouldRestart", None)
    assert "Make it NotRequired" in found.message
    other = [{"resourceName": "memory", "restartPolicy": "RestartContainer"}]
    assert only(world(MORE, pod=running(resizePolicy=other))).write is not None


@pytest.mark.parametrize(
    ("condition", "reason", "words"),
    [
        (
            {"type": "PodResizePending", "reason": "Deferred", "message": "Node didn't have enough resource: cpu"},
            "Deferred",
            "is to have cpu 1500m, but not now: Node didn't have enough resource: cpu. The kubelet retries when the node has room",
        ),
        (
            {"type": "PodResizePending", "reason": "Infeasible", "message": "Node didn't have enough capacity: cpu."},
            "Infeasible",
            "capacity: cpu. Request less in the policy",
        ),
        ({"type": "PodResizeInProgress"}, "InProgress", "is to have cpu 1500m"),
        (
            {"type": "PodResizeInProgress", "reason": "Error", "message": "cgroup"},
            "ResizeError",
            "is to have cpu 1500m: cgroup",
        ),
    ],
)
def test_the_answer_of_the_kubelet_is_reported(condition: Object, reason: str, words: str) -> None:
    pod = running(resources={"requests": {"cpu": "1500m"}, "limits": {"cpu": "1500m"}})
    pod["status"]["conditions"].append({"status": "True", **condition})
    found = only(world(MORE, pod=pod))
    assert (found.reason, found.write) == (reason, None)
    assert words in found.message


def test_a_resize_is_complete_when_the_container_status_has_the_resources() -> None:
    pod = running(resources={"requests": {"cpu": "1500m"}, "limits": {"cpu": "1500m"}})
    pod["status"]["containerStatuses"][0]["resources"] = SLOW
    assert only(world(MORE, pod=pod)).reason == "InProgress"


def test_a_resize_that_the_api_server_refuses_is_reported() -> None:
    made = world(MORE, {"resize": {"container": "understudy-agent", "cpu": "20m"}})
    first, second = outcomes(made)
    refused = in_place_resize.refused(first, Problem("Forbidden", "Pod w-a: exceeded quota"))
    assert (refused.reason, refused.write) == ("Refused", None)
    status = in_place_resize.judged([refused, second])
    assert status is not None
    assert (status.status, status.reason) == ("False", "Refused")
    assert "exceeded quota" in status.message


AMOUNTS = st.dictionaries(
    st.sampled_from(["cpu", "memory"]), st.integers(1, 64).map(lambda n: f"{n * 50}m"), max_size=2
)


@given(AMOUNTS, AMOUNTS, st.dictionaries(st.sampled_from(["cpu", "memory"]), st.integers(1, 64).map(str), min_size=1))
def test_a_resize_never_lowers_values_or_adds_limits_and_is_idempotent(
    requests: dict[str, str], limits: dict[str, str], amounts: dict[str, str]
) -> None:
    before = {"requests": requests, "limits": limits}
    more = in_place_resize.raised(before, amounts)
    after = {kind: {**before[kind], **more.get(kind, {})} for kind in before}
    for kind in before:
        for resource, had in before[kind].items():
            assert amount(after[kind][resource]) >= amount(had)
    assert after["limits"].keys() == limits.keys()
    assert all(amount(after["requests"][resource]) >= amount(given_) for resource, given_ in amounts.items())
    assert in_place_resize.raised(after, amounts) == {}


@pytest.mark.parametrize("resize", [{}, {"container": "app"}, {"cpu": "0"}, {"cpu": "1 core"}, {"memory": "1"}])
def test_a_resize_without_a_valid_amount_is_refused(resize: Object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        Resize.model_validate(resize)


class TestStatus:
    def test_the_condition_exists_only_while_there_is_a_resize_to_report(self) -> None:
        made = world(MORE)
        active = source_pod("w-a")
        made.own(gate(made.workload, active=active, epoch=1))
        from understudy.controller.reconcile.reconciler import _says
        from understudy.controller.status import workload_status

        condition_status = in_place_resize.judged(outcomes(made))
        status = workload_status.status(made.observed(), made.understood(), (), condition_status)
        assert [c["type"] for c in status["conditions"]][-1] == "Resized"
        item = {"status": {**status, "conditions": status["conditions"]}}
        assert _says(item, status)
        without = workload_status.status(made.observed(), made.understood(), ())
        assert not _says(item, without), "what isn't so any more is taken back"
