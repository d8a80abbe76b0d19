"""Checks the situations of a policy: whether each can ever apply, and whether its pools exist."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from understudy.api.kinds.fallback_pool import has_standbys
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest, at, items


def paths(policy: Manifest) -> Iterator[tuple[str, Any]]:
    """Yield the paths at which strategies of situations name a pool, and the names."""
    for index, situation in enumerate(items(policy.data, "spec", "situations")):
        for place, strategy in enumerate(items(situation, "strategies")):
            name = at(strategy, "poolRef", "name")
            yield f"spec.situations[{index}].strategies[{place}].poolRef.name", name


def unreachable(policy: Manifest) -> Iterator[Finding]:
    """Report a situation with the same condition as an earlier one: it never applies."""
    before: list[tuple[str, Any]] = []
    for index, situation in enumerate(items(policy.data, "spec", "situations")):
        name, when = str(at(situation, "name") or ""), at(situation, "when")
        first = next((other for other, known_by in before if known_by == when), None)
        if when and first is not None:
            message = (
                f"is the same as that of the situation {first}, which comes first, so this situation never applies; change the "
                f"condition, or merge the two"
            )
            yield policy.finding(f"spec.situations[{index}].when", message, warning=True)
        before.append((name, when))


def empty(policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Report situations that use a pool with perWorkload 0, which never has a standby."""
    near = {one.name: one.data for one in pools if policy.together(one)}
    for path, name in paths(policy):
        spec = at(near, name, "spec")
        if has_standbys(at(spec, "readiness")) and at(spec, "perWorkload") == 0:
            message = (
                f"FallbackPool {name} has perWorkload 0, so it has no standby in this situation either; set perWorkload: 1. "
                f"Standbys exist only while the applicable strategies name their pool"
            )
            yield policy.finding(path, message, warning=True)
