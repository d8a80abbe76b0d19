"""Reads the policy to evaluate from a file that may contain other objects too."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import dataclass
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
    """A FailurePolicy in which ``understudy check`` finds no error."""

    manifest: Manifest
    spec: FailurePolicySpec

    @property
    def name(self) -> str:
        """Its name."""
        return self.manifest.name

    @property
    def debounce(self) -> float:
        """Seconds for which the tree must be failed until the failure is detected."""
        return seconds(self.spec.monitoring.debounce)

    @property
    def grace(self) -> float:
        """Seconds within which an instance must become healthy for the first time."""
        return seconds(self.spec.monitoring.startup_grace)

    def tree(self, fields: Fields | None) -> HealthTree:
        """Load its health tree; ``fields`` gives the fields of message types, to check conditions. Raises CommandError."""
        try:
            return load_monitoring(self.spec.monitoring, fields=fields)
        except TreeError as error:
            problems = (str(self.manifest.finding(problem.path, problem.message)) for problem in error.problems)
            raise CommandError("the policy's health tree is invalid\n" + "\n".join(problems)) from error


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose a policy."""
    parser.add_argument(
        "policy_file", metavar="POLICY.yaml", help="a file with a FailurePolicy, or - for standard input"
    )
    parser.add_argument("--policy", metavar="NAME", help="the policy, if the file contains several")


def read(file: str, name: str | None = None, grace: str | None = None) -> Policy:
    """Read the policy of a file (``-`` is standard input), by name if it contains several, and optionally with another ``grace``,
    such as ``3s``. Raises CommandError.
    """
    shown = "<stdin>" if file == STANDARD_INPUT else file
    try:
        content = sys.stdin.buffer.read() if file == STANDARD_INPUT else Path(file).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: an invalid file name
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise CommandError(f"{file}: {why}; give a file with a {KIND}, or - for standard input") from error
    manifests, found = manifest_reader.read(shown, content)
    if wrong := [str(finding) for finding in found if finding.severity == "error"]:
        raise CommandError("the policy file cannot be read\n" + "\n".join(wrong))
    manifest = _chosen(shown, manifests, name)
    if wrong := [str(finding) for finding in object_check.check(manifest) if finding.severity == "error"]:
        raise CommandError(f"{KIND} {manifest.name or '(no name)'} is invalid\n" + "\n".join(wrong))
    spec = FailurePolicySpec.model_validate(manifest.data["spec"])
    if spec.monitoring.config_map_key_ref is not None:
        spec = _with_config_map_tree(shown, manifest, spec, [one for one in manifests if one.kind == "ConfigMap"])
    if grace is not None:
        try:
            seconds(grace)
        except ValueError as error:
            raise CommandError(f"--grace: {error}") from error
        monitoring = spec.monitoring.model_copy(update={"startup_grace": grace})
        spec = spec.model_copy(update={"monitoring": monitoring})
    return Policy(manifest, spec)


def _with_config_map_tree(
    file: str, policy: Manifest, spec: FailurePolicySpec, config_maps: list[Manifest]
) -> FailurePolicySpec:
    """Return the policy with the health tree of its ConfigMap, from the same file or from the policy's status as kubectl prints it.

    Raises CommandError.
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
            f"{file}: the health tree of {KIND} {policy.name} is in ConfigMap {referred.name}, which is not in this file: give a file that "
            f"contains both, for example from kubectl get failurepolicy/{policy.name} configmap/{referred.name} -o yaml"
        )
    if wrong := [str(finding) for finding in config_map_trees.check([policy], near) if finding.severity == "error"]:
        raise CommandError(f"the health tree of {KIND} {policy.name} is invalid\n" + "\n".join(wrong))
    text = found.data["data"][referred.key]
    tree = load_text(referred.form, text, path=f"data.{referred.key}", grace=seconds(spec.monitoring.startup_grace))
    monitoring = spec.monitoring.model_copy(update={"config_map_key_ref": None, referred.form: tree})
    return spec.model_copy(update={"monitoring": monitoring})


def _chosen(file: str, manifests: list[Manifest], name: str | None) -> Manifest:
    policies = [manifest for manifest in manifests if manifest.kind == KIND]
    if not policies:
        others = ", ".join(manifest.subject for manifest in manifests if manifest.subject)
        found = f"found {others}" if others else "found no object"
        raise CommandError(f"{file}: the file contains no {KIND}, {found}; give the file with the policy")
    names = [manifest.name for manifest in policies]
    if name is None:
        if len(policies) > 1:
            raise CommandError(
                f"{file}: the file contains {len(policies)} policies; choose one with --policy: {', '.join(names)}"
            )
        return policies[0]
    if name not in names:
        raise CommandError(f"{file}: the file contains no {KIND} {name!r:.80}{did_you_mean(name, names)}")
    if names.count(name) > 1:
        raise CommandError(f"{file}: the file contains {names.count(name)} policies named {name!r}; remove one of them")
    return policies[names.index(name)]
