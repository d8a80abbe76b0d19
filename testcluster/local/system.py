"""What runs in every cluster: DNS, and the rights of the node's programs."""

import json
import string
from pathlib import Path

from testcluster.local import controlplane, golden
from testcluster.local.layout import Layout, node_name
from testcluster.local.programs import Programs
from testcluster.progress import wait_until

_MANIFEST = Path(__file__).resolve().parent / "system.yaml"


def apply(layout: Layout, programs: Programs) -> None:
    """Applies the manifests."""
    text = string.Template(_MANIFEST.read_text()).substitute(
        dns_ip=layout.dns_ip, dns_replicas=min(2, layout.node_count), coredns_image=golden.COREDNS_IMAGE
    )
    controlplane.kubectl(layout, programs, "apply", "--server-side", "--force-conflicts", "-f", "-", input=text)


def ready_nodes(layout: Layout, programs: Programs) -> set[str]:
    """The nodes that Kubernetes says are Ready and that nothing keeps pods from."""
    listed = json.loads(controlplane.kubectl(layout, programs, "get", "nodes", "-o", "json"))
    return {
        item["metadata"]["name"]
        for item in listed["items"]
        if any(condition["type"] == "Ready" and condition["status"] == "True" for condition in item["status"].get("conditions", []))
        and not item["spec"].get("taints")
    }


def wait_ready(layout: Layout, programs: Programs, seconds: float = 90) -> None:
    """Returns when all nodes are Ready and DNS serves.

    Raises:
        TimeoutError: with what is missing.
    """
    wanted = {node_name(node) for node in layout.nodes}
    try:
        wait_until(lambda: ready_nodes(layout, programs) >= wanted, seconds, "all nodes are Ready", interval=0.3)
    except TimeoutError as error:
        missing = sorted(wanted - ready_nodes(layout, programs))
        logs = ", ".join(str(layout.state / name / "log") for name in missing)
        raise TimeoutError(f"{error}; missing: {', '.join(missing)}; their logs: {logs}") from None
    controlplane.kubectl(layout, programs, "-n", "kube-system", "rollout", "status", "deployment/coredns", f"--timeout={seconds:g}s")
