"""``understudy recommend FILE...``: recommends strategies and their order for a policy's requirements."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

from pydantic.alias_generators import to_camel

from understudy.advice import order_explanation
from understudy.advice.strategy_figures import Figure, Way
from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.kinds.requirements_spec import Level
from understudy.api.output_formats import structured
from understudy.cli.common import option_rules, plot_files
from understudy.cli.common.cluster_access import kubectl
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import wrap_labelled
from understudy.cli.manifests import manifest_reader, object_check
from understudy.cli.manifests.manifest_reader import Manifest
from understudy.cli.plan import strategy_table
from understudy.cli.plan.recommendation import recommended
from understudy.cli.plan.size import share
from understudy.kube.client import Object

MET, NOT_MET = 0, 1
"""Exit statuses besides ERROR."""

_REQUIREMENTS = ("safety", "availability", "resource_usage", "task_criticality")


@reports_errors("recommend")
def main(arguments: list[str]) -> int:
    """Run the command. The result goes to standard output."""
    parser = _parser()
    options = parser.parse_args(arguments)
    for option in ("--namespace", "--context", "--kubeconfig"):
        option_rules.reject_unless(
            parser, options, not options.no_cluster, option, "cannot be combined with --no-cluster"
        )
    if options.plot is not None:
        plot_files.check_plot_file(options.plot)
    manifests = _read(options.files)
    levels = {to_camel(name): level for name in _REQUIREMENTS if (level := getattr(options, name))}
    found = recommended(manifests, options.workload, levels, dict(options.cpu), _recorded(options, manifests))
    if options.plot is not None and len(found) > 1:
        names = ", ".join(one.workload.name for one in found)
        raise CommandError(f"--plot draws one workload, but the files contain {names}: choose one with --workload")
    if options.output == "text":
        print(wrap_labelled("\n\n".join(strategy_table.lines(one) for one in found), terminal.columns(sys.stdout)))
    else:
        print(structured([one.data() for one in found], options.output))
    if options.plot is not None:
        from understudy.cli.plan import tradeoff_plot

        tradeoff_plot.draw(options.plot, found[0])
    return NOT_MET if any(order_explanation.unmet_requirements(one.order) for one in found) else MET


def _read(files: Sequence[str]) -> list[Manifest]:
    """Return the objects of Understudy's kinds in the files. Raises CommandError."""
    manifests: list[Manifest] = []
    for file, content in manifest_reader.contents(files).items():
        read, findings = manifest_reader.read(file, content)
        if wrong := [str(finding) for finding in findings if finding.severity == "error"]:
            raise CommandError("the files cannot be read\n" + "\n".join(wrong))
        manifests += (one for one in read if object_check.is_ours(one))
    return manifests


def _recorded(options: argparse.Namespace, manifests: Sequence[Manifest]) -> dict[tuple[str, str], Object]:
    """Return the workloads in the cluster by the namespace in their file and their name; none if no cluster is configured.

    Raises CommandError if a cluster was selected and does not answer.
    """
    asked = any((options.context, options.kubeconfig, options.namespace))
    known = os.environ.get("KUBECONFIG") or (Path.home() / ".kube" / "config").is_file()
    if options.no_cluster or not (asked or known):
        return {}
    found: dict[tuple[str, str], Object] = {}
    try:
        for namespace in sorted({one.namespace for one in manifests if one.kind == "RobotWorkload"}):
            asking = kubectl.Kubectl(
                argparse.Namespace(**{**vars(options), "namespace": namespace or options.namespace})
            )
            for item in asking.get("robotworkloads")["items"]:
                found[(namespace, item["metadata"]["name"])] = item
    except CommandError as error:
        if asked:
            raise
        print(f"understudy recommend: recoveries in the cluster are not considered: {error}", file=sys.stderr)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy recommend",
        description="Recommends strategies and their order for each RobotWorkload, from the requirements of its "
        "FailurePolicy and the pools that serve it, with the recovery time and the reserved CPU of each strategy. "
        "The times are measured ones if the status of the workload, in the cluster or in a file, records at least "
        "three recoveries by a strategy. Otherwise they are published figures, and marked so. The command changes "
        "nothing.",
        epilog="Exit status: 0, or 1 if the requirements cannot be met, or 2 on an error. The rules and the "
        "figures are in docs/choosing.md.",
    )
    option_rules.add_examples(
        parser, "understudy recommend fleet/", "understudy recommend fleet/ --availability High --plot tradeoff.png"
    )
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="manifests of workloads, their policies and their pools: a file, a folder (its *.yaml and *.yml), or - for standard input",
    )
    parser.add_argument("--workload", metavar="NAME", help="only this workload")
    for name in _REQUIREMENTS:
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, choices=get_args(Level), help=f"{to_camel(name)} instead of the policy's")
    parser.add_argument(
        "--cpu",
        type=_share,
        action="append",
        default=[],
        metavar="READINESS=SHARE",
        help="measured CPU of a waiting instance, as a share of a working instance's, such as Initialized=0.4",
    )
    parser.add_argument(
        "--plot",
        metavar="FILE.png",
        help="plot the recovery time against the reserved CPU (needs the extra understudy[plots])",
    )
    option_rules.add_output(parser, "output format (default: text)")
    parser.add_argument("-n", "--namespace", help="namespace of workloads whose files do not name one")
    parser.add_argument("--context", help="context of the kubeconfig")
    parser.add_argument("--kubeconfig", help="path of the kubeconfig")
    parser.add_argument("--no-cluster", action="store_true", help="do not read recoveries from a cluster")
    return parser


def _share(text: str) -> tuple[Way, Figure]:
    name, _, number = text.partition("=")
    readiness: Iterator[Readiness] = (one for one in get_args(Readiness) if one == name)
    found = next(readiness, None)
    value = share(number)
    if found is None or not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(
            f"found {text!r:.50}; give one of {', '.join(get_args(Readiness))} with a share, such as Initialized=0.4 or Initialized=40%"
        )
    return found, Figure(value, "given")
