"""Checks health trees that FailurePolicies load from ConfigMaps among the given files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Monitoring
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest, at
from understudy.cli.manifests.object_check import placed
from understudy.cli.manifests.schema_validation import join
from understudy.controller.observed import kube_objects
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.positions import WHOLE_FILE

_PATH = "spec.monitoring.configMapKeyRef"
IN_THE_CLUSTER = "Ignore this if it is in the cluster already"


def check(policies: Sequence[Manifest], config_maps: Sequence[Manifest]) -> Iterator[Finding]:
    """Yield references without a target, and the problems of the referenced trees."""
    for policy in policies:
        try:
            monitoring = Monitoring.model_validate(at(policy.data, "spec", "monitoring"))
        except ValidationError:
            continue  # reported already
        if monitoring.config_map_key_ref is not None:
            yield from _referred(policy, monitoring, [one for one in config_maps if policy.together(one)])


def missing(manifest: Manifest, path: str, kind: str, name: Any, known: Sequence[Manifest]) -> Iterator[Finding]:
    """Report a reference to an object that is not among the given ones."""
    near = [other.name for other in known if manifest.together(other)]
    if isinstance(name, str) and name and name not in near:
        hint = f" ({kube_objects.hint(name, near)})" if near else ""
        message = (
            f'no {kind} "{name}" in the given files{hint}; correct the name, or give the file that contains it. '
            f"{IN_THE_CLUSTER}"
        )
        yield manifest.finding(path, message, warning=True)


def _referred(policy: Manifest, monitoring: Monitoring, config_maps: Sequence[Manifest]) -> Iterator[Finding]:
    referred = monitoring.config_map_key_ref
    assert referred is not None
    found = next((one for one in config_maps if one.name == referred.name), None)
    if found is None:
        yield from missing(policy, f"{_PATH}.name", "ConfigMap", referred.name, config_maps)
        return
    if found.labels.get(names.HEALTH_TREE) != "true":
        message = (
            f"FailurePolicy {policy.name} loads its health tree from this ConfigMap, which requires the label "
            f'{names.HEALTH_TREE}: "true"; add it'
        )
        yield found.finding("metadata.labels", message)
    data = found.data.get("data")
    text = at(data, referred.key)
    if not isinstance(text, str):
        there = kube_objects.hint(referred.key, data) if isinstance(data, Mapping) and data else "it has none"
        yield policy.finding(f"{_PATH}.key", f'ConfigMap {found.name} has no "{referred.key}" in its data ({there})')
        return
    path = join("data", referred.key)
    begins = found.texts.get(path)
    yield from placed(
        found,
        lambda: load_text(
            referred.form, text, path=path, grace=seconds(monitoring.startup_grace), begins=begins or WHOLE_FILE
        ),
        known=begins is not None,
    )
