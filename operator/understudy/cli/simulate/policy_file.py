"""The policy that is tried, out of a file that may hold more than it."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec, in_force
from understudy.cli.common.errors import CommandError
from understudy.cli.manifests import config_map_trees, manifest_reader, object_check
from understudy.cli.manifests.manifest_reader import Manifest
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.expressions import Fields
from understudy.trees.source.problems import TreeError, did_you_mean

KIND = "FailurePolicy"
STANDARD_INPUT = "-"


@dataclass(frozen=True)
class Policy:
    """A FailurePolicy of a file, without a mistake that ``understudy check`` would find."""

    manifest: Manifest
    spec: FailurePolicySpec

    @property
    def name(self) -> str:
        """Its name."""
        return self.manifest.name

    @property
    def debounce(self) -> float:
        """Seconds for which the tree must have failed before that counts."""
        return seconds(self.spec.monitoring.debounce)

    @property
    def grace(self) -> float:
        """Seconds that an instance has to become healthy for the first time."""
        return seconds(self.spec.monitoring.startup_grace)

    def with_grace(self, grace: str) -> Policy:
        """The same with another grace, such as ``3s``."""
        monitoring = self.spec.monitoring.model_copy(update={"startup_grace": grace})
        return replace(self, spec=self.spec.model_copy(update={"monitoring": monitoring}))

    def tree(self, fields: Fields | None) -> HealthTree:
        """Its health tree; conditions over messages are checked by their types' ``fields``. Raises CommandError."""
        try:
            return load_monitoring(self.spec.monitoring, fields=fields)
        except TreeError as error:
            told = (str(self.manifest.finding(problem.path, problem.message)) for problem in error.problems)
            raise CommandError("the policy's health tree doesn't load\n" + "\n".join(told)) from error


def read(file: str, name: str | None = None, grace: str | None = None) -> Policy:
    """The policy of a file (``-`` is standard input), the one of this name where it holds several; with another ``grace``, such
    as ``3s``, where one is given. Raises CommandError.
    """
    shown = "<stdin>" if file == STANDARD_INPUT else file
    try:
        content = sys.stdin.buffer.read() if file == STANDARD_INPUT else Path(file).read_bytes()
    except (OSError, ValueError) as error:  # a ValueError: a name that no file can have
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise CommandError(f"{file}: {why}; give a file with a {KIND}, or - for standard input") from error
    manifests, found = manifest_reader.read(shown, content)
    if wrong := [str(finding) for finding in found if finding.severity == "error"]:
        raise CommandError("the file with the policy can't be read\n" + "\n".join(wrong))
    manifest = _chosen(shown, manifests, name)
    if wrong := [str(finding) for finding in object_check.check(manifest) if finding.severity == "error"]:
        raise CommandError(f"{KIND} {manifest.name or '(no name)'} can't be followed\n" + "\n".join(wrong))
    spec = FailurePolicySpec.model_validate(manifest.data["spec"])
    if spec.monitoring.config_map_key_ref is not None:
        spec = _lent(shown, manifest, spec, [one for one in manifests if one.kind == "ConfigMap"])
    policy = Policy(manifest, spec)
    if grace is None:
        return policy
    try:
        seconds(grace)
    except ValueError as error:
        raise CommandError(f"--grace: {error}") from error
    return policy.with_grace(grace)


def _lent(file: str, policy: Manifest, spec: FailurePolicySpec, config_maps: list[Manifest]) -> FailurePolicySpec:
    """A policy with the health tree of the ConfigMap that it refers to: out of the same file, or else out of the policy's own
    status, as kubectl prints it. Raises CommandError.
    """
    referred = spec.monitoring.config_map_key_ref
    assert referred is not None
    near = [one for one in config_maps if policy.together(one)]
    found = next((one for one in near if one.name == referred.name), None)
    if found is None:
        kept = in_force(spec, status if isinstance(status := policy.data.get("status"), Mapping) else None)
        if kept is not None:
            return kept
        raise CommandError(
            f"{file}: the health tree of {KIND} {policy.name} is in ConfigMap {referred.name}, which isn't in this file: give one that "
            f"holds both, as by kubectl get failurepolicy/{policy.name} configmap/{referred.name} -o yaml"
        )
    if wrong := [str(finding) for finding in config_map_trees.check([policy], near) if finding.severity == "error"]:
        raise CommandError(f"the health tree of {KIND} {policy.name} can't be followed\n" + "\n".join(wrong))
    text = found.data["data"][referred.key]
    tree = load_text(referred.form, text, path=f"data.{referred.key}", grace=seconds(spec.monitoring.startup_grace))
    monitoring = spec.monitoring.model_copy(update={"config_map_key_ref": None, referred.form: tree})
    return spec.model_copy(update={"monitoring": monitoring})


def _chosen(file: str, manifests: list[Manifest], name: str | None) -> Manifest:
    policies = [manifest for manifest in manifests if manifest.kind == KIND]
    if not policies:
        others = ", ".join(manifest.subject for manifest in manifests if manifest.subject)
        found = f"found {others}" if others else "found no object at all"
        raise CommandError(f"{file}: there is no {KIND} in it, {found}; give the file that holds the policy")
    names = [manifest.name for manifest in policies]
    if name is None:
        if len(policies) > 1:
            raise CommandError(f"{file}: it holds {len(policies)} policies; choose one by --policy: {', '.join(names)}")
        return policies[0]
    if name not in names:
        raise CommandError(f"{file}: there is no {KIND} {name!r:.80} in it{did_you_mean(name, names)}")
    if names.count(name) > 1:
        raise CommandError(f"{file}: it holds {names.count(name)} policies named {name!r}; leave one of them out")
    return policies[names.index(name)]
