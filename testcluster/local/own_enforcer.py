"""This provider's own enforcer (netpol), and Debian's CNI plugins."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from testcluster import golang
from testcluster.local.enforcer import Enforcer, Kubectl, etc
from testcluster.local.layout import OWN, Layout, node_name
from testcluster.progress import Progress

_SOURCE = Path(__file__).resolve().parent / "netpol"


class OwnEnforcer(Enforcer):
    """Rules of nftables."""

    name = OWN
    users: ClassVar = {"netpol": "/CN=understudy:netpol"}

    @classmethod
    def ensure(cls, progress: Progress) -> "OwnEnforcer":
        """Build it unless it is there. Raises CommandFailed and MissingPrograms."""
        built = golang.build("netpol", _SOURCE, ["."], ["-ldflags=-s -w"], progress, "a minute, once")
        return cls(built / "understudy-netpol")

    @property
    def plugins(self) -> str:
        return "/usr/lib/cni"

    def configure(self, layout: Layout, node: int) -> None:
        (etc(layout, node) / "cni" / "10-pods.conflist").write_text(_cni(layout, node))

    def command(self, layout: Layout, node: int) -> Sequence[str | Path]:
        return [self.link(layout, node), *self.words(layout, node), "--node", node_name(node)]

    def words(self, layout: Layout, node: int) -> Sequence[str]:
        return ["--kubeconfig", str(layout.state / "pki" / "netpol.conf")]

    def complete(self, layout: Layout, kubectl: Kubectl) -> None:
        """Write nothing: the rights of its user are in system.yaml."""


def _cni(layout: Layout, node: int) -> str:
    return f"""{{
  "cniVersion": "1.0.0",
  "name": "pods",
  "plugins": [
    {{
      "type": "ptp",
      "ipMasq": false,
      "ipam": {{
        "type": "host-local",
        "ranges": [[{{"subnet": "{layout.pod_network(node)}"}}]],
        "routes": [{{"dst": "0.0.0.0/0"}}],
        "dataDir": "/run/cni-addresses"
      }}
    }},
    {{"type": "portmap", "capabilities": {{"portMappings": true}}}}
  ]
}}
"""
