"""Checks health trees that FailurePolicies load from ConfigMaps among the given files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from pydantic import ValidationError

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Monitoring
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest
from understudy.cli.manifests.object_check import placed
from understudy.cli.manifests.schema_validation import join
from understudy.controller.observed import kube_objects
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.positions import WHOLE_FILE

_PATH = "spec.monitoring.configMapKeyRef"
_IN_THE_CLUSTER = "Ignore this if it is in the cluster already"


def check(policies: Sequence[Manifest], config_maps: Sequence[Manifest]) -> Iterator[Finding]:
    """Yield references without a target, and the problems of the referenced trees."""
    for policy in policies:
        spec = policy.data.get("spec")
        try:
            monitoring = Monitoring.model_validate(spec.get("monitoring") if isinstance(spec, Mapping) else None)
        except ValidationError:
            continue  # reported already
        if monitoring.config_map_key_ref is not None:
            yield from _referred(policy, monitoring, [one for one in config_maps if policy.together(one)])


def _referred(policy: Manifest, monitoring: Monitoring, config_maps: Sequence[Manifest]) -> Iterator[Finding]:
    referred = monitoring.config_map_key_ref
    assert referred is not None
    found = next((one for one in config_maps if one.name == referred.name), None)
    if found is None:
        near = [one.name for one in config_maps]
        hint = f" ({kube_objects.hint(referred.name, near)})" if near else ""
        message = (
            f'no ConfigMap "{referred.name}" in the given files{hint}; correct the name, or give the file that contains it. '
            f"{_IN_THE_CLUSTER}"
        )
        yield policy.finding(f"{_PATH}.name", message, warning=True)
        return
    if found.labels.get(names.HEALTH_TREE) != "true":
        message = (
            f"FailurePolicy {policy.name} loads its health tree from this ConfigMap, which requires the label "
            f'{names.HEALTH_TREE}: "true"; add it'
        )
        yield found.finding("metadata.labels", message)
    data = found.data.get("data")
    text = data.get(referred.key) if isinstance(data, Mapping) else None
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
