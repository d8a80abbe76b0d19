"""Health trees in ConfigMaps: found by the policy's reference, and checked before any monitor uses them."""

from __future__ import annotations

import json
from collections.abc import Mapping

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Monitoring, TreeInForce, TreeReference
from understudy.controller.observed import kube_objects, tree_verdicts
from understudy.controller.plan import Problem
from understudy.kube.client import Object
from understudy.trees.languages.tree_check import TreeText

FIELD = "spec.monitoring.configMapKeyRef"


def reference(policy: Object) -> str:
    """Return the ConfigMap with a policy's health tree; empty if the tree is in the policy."""
    monitoring = (policy.get("spec") or {}).get("monitoring") or {}
    found: str = (monitoring.get("configMapKeyRef") or {}).get("name", "")
    return found


def lent(config_map: Object) -> bool:
    """Whether the owner of a ConfigMap permits policies to read it."""
    return kube_objects.labels(config_map).get(names.HEALTH_TREE) == "true"


def find(monitoring: Monitoring, config_maps: Mapping[str, Object], namespace: str) -> TreeInForce | Problem | None:
    """Return the tree that a policy refers to, or the problem with it; None if the tree is in the policy.

    Raises Unjudged.
    """
    referred, tree = monitoring.config_map_key_ref, written(monitoring, config_maps, namespace)
    if referred is None or tree is None or isinstance(tree, Problem):
        return tree if isinstance(tree, Problem) else None
    verdict = tree_verdicts.of(tree)
    if verdict.reason:
        return Problem(verdict.reason, verdict.message)
    return TreeInForce(name=referred.name, key=referred.key, **{referred.form: json.loads(verdict.tree)})


def written(monitoring: Monitoring, config_maps: Mapping[str, Object], namespace: str) -> TreeText | Problem | None:
    """Return the tree that a policy refers to, to be checked, or why there is none; None if the tree is in the policy."""
    referred = monitoring.config_map_key_ref
    if referred is None:
        return None
    text = _text(referred, config_maps, namespace)
    if isinstance(text, Problem):
        return text
    path = f"ConfigMap {referred.name}, {referred.key}"
    return TreeText("file", referred.form, text, path, seconds(monitoring.startup_grace))


def _text(referred: TreeReference, config_maps: Mapping[str, Object], namespace: str) -> str | Problem:
    known = {name: item for name, item in config_maps.items() if lent(item)}
    found = known.get(referred.name)
    if found is None:
        label = f"{names.HEALTH_TREE}=true"
        return Problem(
            "TreeNotFound",
            f'{FIELD}.name: no ConfigMap "{referred.name}" with the label {label} in namespace {namespace} '
            f"({kube_objects.hint(referred.name, known)}). Create it, or, if it exists, let policies read it: "
            f"kubectl label configmap -n {namespace} {referred.name} {label}",
        )
    data = found.get("data") or {}
    text = data.get(referred.key)
    if text is None:
        there = kube_objects.hint(referred.key, data) if data else "it has none"
        return Problem(
            "TreeNotFound",
            f'{FIELD}.key: ConfigMap {referred.name} has no "{referred.key}" in its data ({there}). Correct the ConfigMap or the key',
        )
    return str(text)
