"""The pods of every cluster: DNS, and the rights of the node's programs."""

import json
import string
from datetime import datetime
from functools import partial
from pathlib import Path

from testcluster.local import controlplane, dns, golden
from testcluster.local.layout import Layout, node_name
from testcluster.local.programs import Programs
from testcluster.progress import wait_until
from testcluster.shell import CommandFailed

_MANIFEST = Path(__file__).resolve().parent / "system.yaml"


def dns_replicas(layout: Layout) -> int:
    """Return the number of DNS pods of a cluster: two if it has two nodes, so that one outlives a node."""
    return min(2, layout.node_count)


def apply(layout: Layout, programs: Programs) -> None:
    """Apply the manifests, for up to a minute, because an API server that has just started may not serve all kinds yet."""
    text = string.Template(_MANIFEST.read_text()).substitute(
        dns_ip=layout.dns_ip, dns_replicas=dns_replicas(layout), coredns_image=golden.COREDNS_IMAGE
    )

    def applied() -> bool:
        controlplane.kubectl(layout, programs, "apply", "--server-side", "--force-conflicts", "-f", "-", input=text)
        return True

    wait_until(applied, 60, "the cluster's own objects are there", interval=0.5, despite=CommandFailed)
    programs.enforcer.complete(layout, partial(controlplane.kubectl, layout, programs))


def ready_nodes(layout: Layout, programs: Programs) -> set[str]:
    """Return the nodes that are Ready and accept pods, according to Kubernetes."""
    listed = json.loads(controlplane.kubectl(layout, programs, "get", "nodes", "-o", "json"))
    return {
        item["metadata"]["name"]
        for item in listed["items"]
        if any(
            condition["type"] == "Ready" and condition["status"] == "True"
            for condition in item["status"].get("conditions", [])
        )
        and not item["spec"].get("taints")
    }


def _renewed_nodes(layout: Layout, programs: Programs, since: datetime) -> set[str]:
    """Return the nodes whose kubelet has sent a heartbeat since a time. A lost node counts as Ready for a while."""
    listed = json.loads(controlplane.kubectl(layout, programs, "-n", "kube-node-lease", "get", "leases", "-o", "json"))
    return {
        item["metadata"]["name"]
        for item in listed["items"]
        if item["spec"].get("renewTime") and datetime.fromisoformat(item["spec"]["renewTime"]) >= since
    }


def _dns_serves(layout: Layout, programs: Programs) -> bool:
    """Return whether every DNS pod is ready and answers."""
    slices = json.loads(
        controlplane.kubectl(
            layout,
            programs,
            "-n",
            "kube-system",
            "get",
            "endpointslices",
            "-l",
            "kubernetes.io/service-name=kube-dns",
            "-o",
            "json",
        )
    )
    ready = [
        address
        for item in slices["items"]
        for endpoint in item["endpoints"] or ()
        if endpoint.get("conditions", {}).get("ready")
        for address in endpoint["addresses"]
    ]
    return len(ready) >= dns_replicas(layout) and all(
        dns.answers(address, "kubernetes.default.svc.cluster.local") for address in ready
    )


def wait_ready(layout: Layout, programs: Programs, since: datetime, seconds: float = 300) -> None:
    """Wait until all nodes are Ready, with a heartbeat after a given time, and DNS answers.

    Raises:
        TimeoutError: with what is missing.
    """
    wanted = {node_name(node) for node in layout.nodes}

    missing = wanted

    def all_ready() -> bool:
        nonlocal missing
        missing = wanted - (ready_nodes(layout, programs) & _renewed_nodes(layout, programs, since))
        return not missing

    try:
        wait_until(all_ready, seconds, "all nodes are Ready", interval=0.3, despite=CommandFailed)
    except TimeoutError as error:
        logs = ", ".join(str(layout.state / name / "log") for name in sorted(missing))
        raise TimeoutError(f"{error}; missing: {', '.join(sorted(missing))}; their logs: {logs}") from None
    wait_until(
        lambda: _dns_serves(layout, programs),
        seconds,
        "DNS serves (kubectl -n kube-system describe pods)",
        interval=0.3,
        despite=CommandFailed,
    )
