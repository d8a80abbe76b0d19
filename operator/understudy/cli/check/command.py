"""``understudy check FILE...``: validates manifests without a cluster."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.api.output_formats import structured
from understudy.cli.check import mux_check, reference_check, robot_node_check
from understudy.cli.common.errors import reports_errors
from understudy.cli.common.option_rules import add_examples, add_output
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import counted
from understudy.cli.manifests import config_map_trees, manifest_reader, object_check, placeholders
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest


@dataclass
class Result:
    """The result of a check."""

    findings: list[Finding] = field(default_factory=list)
    """In the order of the files, and of the lines in each."""
    files: int = 0
    checked: int = 0
    """Objects of Understudy's kinds."""
    skipped: int = 0
    """Objects of other kinds."""

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return sum(finding.severity == "error" for finding in self.findings)

    @property
    def warnings(self) -> int:
        """Number of findings that are warnings."""
        return len(self.findings) - self.errors

    def totals(self) -> str:
        """Summarize the result in one line."""
        others = f" ({counted(self.skipped, 'object')} of other kinds skipped)" if self.skipped else ""
        found = f"{counted(self.errors, 'error')}, {counted(self.warnings, 'warning')}"
        return f"{counted(self.checked, 'object')} checked in {counted(self.files, 'file')}{others}: {found}"

    def to_wire(self) -> dict[str, Any]:
        """Return the result as JSON data."""
        counts = {"files": self.files, "checked": self.checked, "passedOver": self.skipped}
        found = [finding.to_wire() for finding in self.findings]
        return {**counts, "errors": self.errors, "warnings": self.warnings, "findings": found}


def check(files: Sequence[tuple[str, bytes]]) -> Result:
    """Check the contents of files, each with the name that findings show."""
    result = Result(files=len(files))
    ours: list[Manifest] = []
    others: list[Manifest] = []
    for name, content in files:
        manifests, found = manifest_reader.read(name, content)
        result.findings += found
        for manifest in manifests:
            if object_check.is_ours(manifest):
                ours.append(manifest)
                result.findings += object_check.check(manifest)
            else:
                result.skipped += 1
                others.append(manifest)
                result.findings += _other(manifest)
    result.checked = len(ours)
    result.findings += reference_check.check(ours)
    config_maps = [one for one in others if one.kind == "ConfigMap"]
    result.findings += config_map_trees.check([one for one in ours if one.kind == "FailurePolicy"], config_maps)
    result.findings += mux_check.check(ours, others)
    result.findings += robot_node_check.check(ours, others)
    order = {name: number for number, (name, _) in enumerate(files)}
    result.findings = sorted(dict.fromkeys(result.findings), key=lambda one: (order[one.file], one.place))
    return result


def _other(manifest: Manifest) -> Iterator[Finding]:
    if not manifest.kind and not _has_parameters(manifest.data):
        message = "missing, so this document is skipped; if it should be an object, add apiVersion and kind"
        yield manifest.finding("kind", message, warning=True)
    for path, message in placeholders.problems(manifest.data):
        yield manifest.finding(path, message)


def _has_parameters(data: Any) -> bool:
    """Return whether a document has ROS parameters, by node or by namespace: such files often lie next to manifests."""
    nodes = [one for one in data.values() if isinstance(one, Mapping)] if isinstance(data, Mapping) else []
    deeper = [one for node in nodes for one in node.values() if isinstance(one, Mapping)]
    return any("ros__parameters" in one for one in [*nodes, *deeper])


@reports_errors("check")
def main(arguments: list[str]) -> int:
    """Run the command. The findings go to standard output, one line each, and the totals to standard error."""
    parser = argparse.ArgumentParser(
        prog="understudy check",
        description="Checks manifests of RobotWorkloads, FailurePolicies and FallbackPools without a cluster. It "
        "applies the rules of the API server, parses the trees, and checks references between the given files. It "
        "skips objects of other kinds.",
        epilog="Exit status: 0 without errors, 1 with errors, 2 if a file cannot be read.",
    )
    add_examples(parser, "understudy check fleet/", "helm template fleet | understudy check -")
    parser.add_argument(
        "files", nargs="*", metavar="FILE", help="a manifest, a folder (its *.yaml and *.yml), or - for standard input"
    )
    parser.add_argument(
        "-f", "--filename", action="append", default=[], metavar="FILE", help="the same, as kubectl has it"
    )
    parser.add_argument("-R", "--recursive", action="store_true", help="read the subfolders of folders too")
    parser.add_argument("--strict", action="store_true", help="exit with 1 also for warnings")
    add_output(parser, "one line per finding, or all details as JSON or YAML")
    options = parser.parse_args(arguments)
    files = [*options.files, *options.filename]
    if not files:
        parser.error("give a file or a folder with manifests, or - for standard input")
    result = check(list(manifest_reader.contents(files, recursive=options.recursive).items()))
    text = options.output == "text"
    terminal.write(map(str, result.findings) if text else [structured(result.to_wire(), options.output)])
    print(f"understudy check: {result.totals()}", file=sys.stderr)
    return 1 if result.errors or (options.strict and result.warnings) else 0
