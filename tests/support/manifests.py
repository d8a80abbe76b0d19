"""Checks for the manifests of all examples and of the pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec

MODELS = {"RobotWorkload": RobotWorkloadSpec, "FailurePolicy": FailurePolicySpec, "FallbackPool": FallbackPoolSpec}


WITH_A_LEAF_OF_ITS_OWN = "writing-a-leaf.md"
"""A page with a policy that needs an extra package. tests/unit/docs/test_writing_a_leaf.py installs it."""


def covers(read: Any, written: Any) -> bool:
    """Return whether the parsed data contains everything that was written. The models ignore unknown fields, so a lost
    field is a mistake."""
    if isinstance(written, dict):
        return isinstance(read, dict) and all(k in read and covers(read[k], v) for k, v in written.items())
    if isinstance(written, list):
        return isinstance(read, list) and len(read) == len(written) and all(map(covers, read, written))
    return bool(read == written)


def assert_references_lead_somewhere(
    workload: Mapping[str, Any], policies: Sequence[Mapping[str, Any]], pools: Sequence[Mapping[str, Any]]
) -> None:
    """Assert that all references between a workload, its policies and their pools have a target."""
    named = {one["metadata"]["name"]: one["spec"] for one in policies}
    found = {one["metadata"]["name"]: one["spec"] for one in pools}
    assert workload["spec"]["failurePolicyRef"]["name"] in named
    assert {s["poolRef"]["name"] for p in named.values() for s in p["strategies"] if "poolRef" in s} == set(found)
    for pool in found.values():
        assert pool["workloadSelector"]["matchLabels"].items() <= workload["metadata"]["labels"].items()
        if "templateFrom" in pool:
            assert pool["templateFrom"]["workload"] == workload["metadata"]["name"]
