"""``understudy check FILE...``: says of manifests, without a cluster, what is wrong with them and what would be right.

Exit status: 0 without errors, 1 with errors (with ``--strict`` also with warnings), 2 where it can't be done as asked for.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.api.output_formats import structured
from understudy.cli.check import reference_check
from understudy.cli.common.errors import CommandError
from understudy.cli.manifests import config_map_trees, manifest_reader, object_check
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest


@dataclass
class Result:
    """What came of a check."""

    findings: list[Finding] = field(default_factory=list)
    """In the order of the files, and of the lines in each."""
    files: int = 0
    checked: int = 0
    """Objects of our kinds."""
    passed_over: int = 0
    """Objects of others."""

    @property
    def errors(self) -> int:
        """How many findings are errors."""
        return sum(finding.severity == "error" for finding in self.findings)

    @property
    def warnings(self) -> int:
        """How many findings are warnings."""
        return len(self.findings) - self.errors

    def totals(self) -> str:
        """All in one line."""
        others = f" ({_count(self.passed_over, 'object')} of other kinds passed over)" if self.passed_over else ""
        found = f"{_count(self.errors, 'error')}, {_count(self.warnings, 'warning')}"
        return f"{_count(self.checked, 'object')} checked in {_count(self.files, 'file')}{others}: {found}"

    def to_wire(self) -> dict[str, Any]:
        """All of it, for programs."""
        counts = {"files": self.files, "checked": self.checked, "passedOver": self.passed_over}
        found = [finding.to_wire() for finding in self.findings]
        return {**counts, "errors": self.errors, "warnings": self.warnings, "findings": found}


def check(files: Sequence[tuple[str, bytes]]) -> Result:
    """Check the contents of files, each with what findings call it."""
    result = Result(files=len(files))
    ours: list[Manifest] = []
    config_maps: list[Manifest] = []
    for name, content in files:
        manifests, found = manifest_reader.read(name, content)
        result.findings += found
        for manifest in manifests:
            if object_check.is_ours(manifest):
                ours.append(manifest)
                result.findings += object_check.check(manifest)
            else:
                result.passed_over += 1
                if manifest.kind == "ConfigMap":
                    config_maps.append(manifest)
                result.findings += _other(manifest)
    result.checked = len(ours)
    result.findings += reference_check.check(ours)
    result.findings += config_map_trees.check([one for one in ours if one.kind == "FailurePolicy"], config_maps)
    order = {name: number for number, (name, _) in enumerate(files)}
    result.findings = sorted(dict.fromkeys(result.findings), key=lambda one: (order[one.file], one.place))
    return result


def _other(manifest: Manifest) -> Iterator[Finding]:
    if not manifest.kind and not _has_parameters(manifest.data):
        message = "missing, so this is passed over; if it is meant to be an object, give apiVersion and kind"
        yield manifest.finding("kind", message, warning=True)


def _has_parameters(data: Any) -> bool:
    """Whether it is a file of ROS parameters, of nodes or of namespaces with nodes: those lie beside manifests."""
    nodes = [one for one in data.values() if isinstance(one, Mapping)] if isinstance(data, Mapping) else []
    deeper = [one for node in nodes for one in node.values() if isinstance(one, Mapping)]
    return any("ros__parameters" in one for one in [*nodes, *deeper])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _lines(result: Result, form: str) -> Iterator[str]:
    if form == "text":
        yield from map(str, result.findings)
    else:
        yield structured(result.to_wire(), form)


def main(arguments: list[str]) -> int:
    """Check what the arguments name; the findings go to standard output, one line each, the totals to standard error."""
    parser = argparse.ArgumentParser(
        prog="understudy check",
        description="Checks manifests of RobotWorkloads, FailurePolicies and FallbackPools without a cluster: by the rules of the API "
        "server, by the loaders of the trees, and what the given files say of each other. Other objects are passed over.",
        epilog="Exit status: 0 without errors, 1 with errors, 2 where a file can't be read.",
    )
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="a manifest, a folder (its *.yaml and *.yml), or - for standard input"
    )
    parser.add_argument("--strict", action="store_true", help="exit with 1 for warnings too")
    parser.add_argument(
        "-o",
        "--output",
        choices=("text", "json", "yaml"),
        default="text",
        help="one line for each finding, or everything as JSON or YAML",
    )
    given = parser.parse_args(arguments)
    try:
        # What is named twice, as by a folder and a pattern, is read once.
        files = dict(entry for argument in dict.fromkeys(given.files) for entry in manifest_reader.contents(argument))
    except CommandError as error:
        print(f"understudy check: {error}", file=sys.stderr)
        return 2
    result = check(list(files.items()))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        for line in _lines(result, given.output):
            print(line)
        sys.stdout.flush()
    except BrokenPipeError:  # read by something like head, which has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    print(f"understudy check: {result.totals()}", file=sys.stderr)
    return 1 if result.errors or (given.strict and result.warnings) else 0
