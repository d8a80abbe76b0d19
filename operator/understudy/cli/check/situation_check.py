"""Checks the situations of a policy: whether each can ever be in force, and whether the pools that it counts on are there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest


def paths(policy: Manifest) -> Iterator[tuple[str, Any]]:
    """Where strategies of situations name a pool, and what stands there."""
    for index, situation in enumerate(_listed(policy)):
        strategies = situation.get("strategies")
        for place, strategy in enumerate(strategies if isinstance(strategies, list) else ()):
            pool = strategy.get("poolRef") if isinstance(strategy, Mapping) else None
            if isinstance(pool, Mapping):
                yield f"spec.situations[{index}].strategies[{place}].poolRef.name", pool.get("name")


def unreachable(policy: Manifest) -> Iterator[Finding]:
    """A situation that is known by the same as one before it is never the first that holds."""
    before: list[tuple[str, Any]] = []
    for index, situation in enumerate(_listed(policy)):
        name, when = str(situation.get("name", "")), situation.get("when")
        first = next((other for other, known_by in before if known_by == when), None)
        if when and first is not None:
            message = (
                f"is the same as that of the situation {first}, which comes before it, so this one is never in force; say when it is "
                f"otherwise, or put the two together"
            )
            yield policy.finding(f"spec.situations[{index}].when", message, warning=True)
        before.append((name, when))


def empty(policy: Manifest, pools: Sequence[Manifest]) -> Iterator[Finding]:
    """Of a pool whose perWorkload is 0 nothing is kept in a situation either."""
    near = {one.name: one.data.get("spec") for one in pools if policy.together(one)}
    for path, name in paths(policy):
        spec = near.get(name) if isinstance(name, str) else None
        if isinstance(spec, Mapping) and spec.get("readiness") != "Uninitialized" and spec.get("perWorkload") == 0:
            message = (
                f"FallbackPool {name} has perWorkload 0, so that it has no standby in this situation either; give it perWorkload 1: "
                f"standbys are kept only while what is in force names their pool"
            )
            yield policy.finding(path, message, warning=True)


def _listed(policy: Manifest) -> list[Mapping[str, Any]]:
    spec = policy.data.get("spec")
    found = spec.get("situations") if isinstance(spec, Mapping) else None
    return [one if isinstance(one, Mapping) else {} for one in found] if isinstance(found, list) else []
