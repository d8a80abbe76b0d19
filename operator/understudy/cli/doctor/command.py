"""``understudy doctor``: checks whether a cluster does what Understudy needs, with packets too. Each finding has its
remedy."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import quote

from understudy import __version__
from understudy.api.output_formats import structured
from understudy.api.plain_text import plain
from understudy.cli.common import option_rules
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robots, chosen
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused, proxied
from understudy.cli.common.errors import ERROR, CommandError, reports_errors
from understudy.cli.common.text import terminal
from understudy.cli.doctor import (
    cilium_check,
    clock_check,
    discovery_check,
    findings,
    installation_check,
    mux_check,
    packet_check,
    rights_check,
    test_pods,
)
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.installation_check import Installed
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Images
from understudy.kube.client import WORKLOADS, Object
from understudy.kube.gates import registry

WELL, NOT_WELL = 0, 1
"""Exit statuses besides ERROR."""

_ENFORCED, _READ = "GateEnforced", "OutputsRead"


@reports_errors("doctor")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    option_rules.reject_unless(
        parser, options, not options.no_pods, "--image", "sets the image of the test pods: remove --no-pods"
    )
    out = sys.stdout
    chosen(options)  # not both names and a selector
    try:
        kubectl = Kubectl(options)
        with _progress() as progress, proxied(kubectl) as api:
            examination = _Examination(kubectl, api, options, progress)
            examination.run()
        found = examination.found
        if options.output == "text":
            print("\n".join(findings.lines(found, columns=terminal.columns(out), colours=terminal.colours(out))))
        else:
            document = {"version": __version__, "namespace": kubectl.namespace, **findings.to_wire(found)}
            print(structured(document | examination.measured, options.output))
        return WELL if findings.is_well(found) else NOT_WELL
    except KeyboardInterrupt:
        print("understudy doctor: interrupted; the objects that it had created are deleted", file=sys.stderr)
        return ERROR


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Show the current step: in a terminal in one line that is erased at the end, else in a line for each step."""
    if not terminal.redraws(sys.stderr):
        yield lambda what: print(plain(what), file=sys.stderr, flush=True)
        return
    try:
        yield lambda what: terminal.replace_line(sys.stderr, f"{what} …")
    finally:
        terminal.replace_line(sys.stderr, "")


class _Examination:
    """Runs the checks one after the other: first requests to the API server, then tests with pods."""

    def __init__(
        self, kubectl: Kubectl, api: Api, options: argparse.Namespace, progress: Callable[[str], None]
    ) -> None:
        self._kubectl, self._api, self._options, self._progress = kubectl, api, options, progress
        self.found: list[Finding] = []
        self.measured: dict[str, Any] = {}

    def run(self) -> None:
        """Run all checks. Raises CommandError if nothing can be checked."""
        namespace = self._kubectl.namespace
        self._progress("asking the API server")
        self.found.append(installation_check.kubernetes(self._api))
        operator = installation_check.find(self._api)
        self.found.append(installation_check.operator(operator))
        self.found += installation_check.definitions_served(self._api)
        self._progress("checking your permissions")
        self.found.append(rights_check.of_this_user(self._api, namespace))
        if operator is not None:
            self.found.append(rights_check.of_the_operator(self._api, namespace, operator))
        workloads = self._workloads(namespace)
        lost = list(discovery_check.servers(self._api, namespace, workloads))
        self.found += lost
        self.found += monitor_findings(workloads)
        self.found += mux_check.check(self._api, namespace, workloads)
        self.found += cilium_check.check(self._api, namespace, workloads)
        if not self._options.no_pods:
            failed = {finding.check for finding in lost}
            try:
                self._try(
                    self._images(operator),
                    [one for one in workloads if discovery_check.check(one) not in failed],
                    by_network=needs_network(workloads),
                )
            except CommandError as error:
                cure = "name with -n a namespace in which you may create pods, or skip them with --no-pods"
                self.found.append(Finding("pods", "FAIL", str(error), cure))

    def _workloads(self, namespace: str) -> Sequence[Object]:
        """Return the workloads that were named, or all. Raises CommandError if a named one does not exist."""
        try:
            if self._options.names:
                return [self._api.get(WORKLOADS.path(namespace, name)) for name in self._options.names]
            selector = f"?labelSelector={quote(self._options.selector)}" if self._options.selector else ""
            items: list[Object] = self._api.get(WORKLOADS.path(namespace) + selector)["items"]
        except Refused as refused:
            if self._options.names:
                raise
            self.found.append(Finding("robots", "WARN", f"they cannot be listed: {refused}", "see your rights, above"))
            return []
        return sorted(items, key=kube_objects.name)

    def _images(self, operator: Installed | None) -> Images:
        """Return the images of the test pods. Raises CommandError."""
        known = operator.images if operator is not None else None
        if self._options.image:
            return replace(known, monitor=self._options.image) if known is not None else Images(self._options.image)
        if known is None:
            raise CommandError("the monitor's image is not known, since no operator is found; give it with --image")
        return known

    def _try(self, images: Images, workloads: Sequence[Object], *, by_network: bool) -> None:
        """Run the checks that need pods; ``by_network`` is whether the network has to enforce gates. Raises CommandError."""
        with (
            clock_check.NodeClocks(self._api) as nodes,
            test_pods.pair(self._kubectl, self._api, images, self._progress) as pods,
        ):
            if by_network:
                gate_test = packet_check.measure(pods, self._progress)
                self.measured["gate"] = packet_check.to_wire(gate_test)
                self.found += packet_check.judge(gate_test)
                measured = gate_test.clocks
            else:
                measured = packet_check.clocks(pods, self._progress)
            self.found += discovery_check.joined(pods, workloads, self._progress)
        clocks = {**nodes.clocks, **measured}
        self.measured["clocks"] = clock_check.to_wire(clocks)
        self.found.append(clock_check.judge(clocks, clock_check.of_api_server(self._api)))


def needs_network(workloads: Sequence[Object]) -> bool:
    """Return whether the network must enforce gates: it need not if each of the workloads has a mux."""
    return not workloads or any(not registry.of(one).is_at_robot for one in workloads)


def monitor_findings(workloads: Sequence[Object]) -> Iterator[Finding]:
    """Yield what the monitors report: their versions, whether their gates are enforced, and who reads the outputs."""
    for workload in workloads:
        name, status = kube_objects.name(workload), workload.get("status") or {}
        if status.get("health") and (version := (status.get("monitor") or {}).get("version")) != __version__:
            found = f"it has version {version}" if version else "its version is earlier than 0.2.0"
            cure = (
                "the operator replaces the monitors one after the other, so wait. If the monitor has an image of your own, build it again "
                "from this version (docs/how-to/custom-messages.md)"
            )
            yield Finding(f"monitor of {name}", "WARN", f"{found}, but this command has version {__version__}", cure)
        for condition in status.get("conditions") or []:
            message = condition["message"]
            if (condition["type"], condition["status"]) == (_ENFORCED, "False"):
                is_reader = condition["reason"] == "ReaderWithoutProfile"
                page = "docs/how-to/robot-outside-the-cluster.md" if is_reader else registry.of(workload).page
                yield Finding(f"gate of {name}", "FAIL", message, page)
            elif (
                condition["type"] == _READ and condition["status"] != "False" and condition["reason"] != "AtGatedPorts"
            ):
                page = "docs/explanation/network-policies.md#who-reads-the-outputs"
                yield Finding(f"outputs of {name}", "WARN", message, page)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy doctor",
        description="Checks whether a cluster does what Understudy needs: Kubernetes, operator and CRDs fit this "
        "version; you and the operator have the rights that they need; the network enforces gates for UDP, and how "
        "soon, or the muxes report; clocks agree; and the robots' discovery servers answer. The command creates two pods and, unless all "
        "robots have a mux, a gate for the test, which send nothing to a robot, and deletes them at the end.",
        epilog="Exit status: 0 if nothing failed (warnings are reported), 1 if something failed, 2 if this cannot be determined.",
    )
    option_rules.add_examples(parser, "understudy doctor -n fleet", "understudy doctor robot-1 --no-pods")
    add_robots(parser)
    parser.add_argument(
        "--no-pods",
        action="store_true",
        help="create no pods, and so skip the checks of packets, clocks and ROS graphs",
    )
    parser.add_argument("--image", help="image of the test pods (default: the monitor image that the operator uses)")
    option_rules.add_output(parser, "text, or everything as JSON or YAML")
    add_options(parser)
    return parser
