"""The command `scripts/cluster`."""

import argparse
import os
import sys
from collections.abc import Callable

from testcluster.local.programs import ENFORCERS
from testcluster.modes import NetworkModes
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError, Provider
from testcluster.providers.current import CurrentProvider
from testcluster.providers.kind import KindProvider
from testcluster.providers.local import LocalProvider

PROVIDERS = ("kind", "local", "current")

_FAULTS: dict[str, tuple[str, Callable[[Provider, str], None]]] = {
    "down": ("cut its power", lambda provider, node: provider.node_down(node)),
    "up": ("switch it on again, thaw it, put its cable back", lambda provider, node: provider.node_up(node)),
    "freeze": ("stop all its processes", lambda provider, node: provider.node_freeze(node, True)),
    "thaw": ("let its processes continue", lambda provider, node: provider.node_freeze(node, False)),
    "cut": ("pull its network cable", lambda provider, node: provider.node_link(node, False)),
    "stop-runtime": (
        "end its kubelet and container runtime; its containers keep running",
        lambda provider, node: provider.node_runtime(node, False),
    ),
    "start-runtime": ("start them again", lambda provider, node: provider.node_runtime(node, True)),
    "connect": ("put its network cable back", lambda provider, node: provider.node_link(node, True)),
}


_API: dict[str, Callable[[Provider], None]] = {
    "stop": lambda provider: provider.api_stop(),
    "start": lambda provider: provider.api_start(),
}


def select(name: str | None, cluster: str | None, progress: Progress, network: str | None = None) -> Provider:
    """Return the provider of a name, or the one that suits this machine: kind if it works here, else local.

    ``network`` is what enforces network policies in a new cluster of the local provider, which can have several.

    Raises:
        ClusterError: there is no provider of this name, or none can be used here; the message says what each lacks.
    """
    if name is None:
        obstacles = {"kind": KindProvider.obstacle(), "local": LocalProvider.obstacle()}
        name = next((candidate for candidate, obstacle in obstacles.items() if obstacle is None), None)
        if name is None:
            lacks = "; ".join(f"{candidate}: {obstacle}" for candidate, obstacle in obstacles.items())
            raise ClusterError(
                f"no cluster can be made on this machine ({lacks}); "
                "--provider current uses the one that kubectl is pointed at"
            )
    if name not in PROVIDERS:
        raise ClusterError(f"provider {name!r}: {', '.join(PROVIDERS[:-1])} or {PROVIDERS[-1]} is needed")
    if network and network not in ENFORCERS:
        raise ClusterError(f"network {network!r}: {' or '.join(ENFORCERS)} is needed")
    if name == "local":
        return LocalProvider(cluster, progress, network)
    if network:
        raise ClusterError(f"provider {name}: its network cannot be chosen, only that of provider local")
    return KindProvider(cluster, progress) if name == "kind" else CurrentProvider(progress)


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add the options that select the cluster."""
    parser.add_argument(
        "--provider",
        choices=PROVIDERS,
        default=os.environ.get("UNDERSTUDY_CLUSTER_PROVIDER") or None,
        help="kind: in Docker; local: from source on this machine, as root; current: the one that KUBECONFIG names "
        "(default: UNDERSTUDY_CLUSTER_PROVIDER, or kind if Docker and kind work, else local)",
    )
    parser.add_argument(
        "--name",
        default=os.environ.get("UNDERSTUDY_CLUSTER_NAME") or None,
        help="name of the cluster (default: UNDERSTUDY_CLUSTER_NAME, or understudy)",
    )


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    common = argparse.ArgumentParser(add_help=False)
    add_selection(common)
    top = argparse.ArgumentParser(
        prog="scripts/cluster", description="A real Kubernetes cluster for trying and testing."
    )
    commands = top.add_subparsers(dest="command", required=True)
    up = commands.add_parser("up", parents=[common], help="make the cluster, or the missing parts of it")
    up.add_argument(
        "--network",
        choices=list(ENFORCERS),
        default=os.environ.get("UNDERSTUDY_CLUSTER_NETWORK") or None,
        help="what enforces network policies in a new cluster of provider local: a small program of its own (default), or Cilium, which is "
        "built here (also: UNDERSTUDY_CLUSTER_NETWORK)",
    )
    commands.add_parser("down", parents=[common], help="remove everything that up made")
    commands.add_parser(
        "status", parents=[common], help="print the state of the cluster; exit code 0 if it can be used"
    )
    load = commands.add_parser("load-image", parents=[common], help="load images into every node")
    load.add_argument("image", nargs="+", help="an archive, or the name of an image that was built here")
    commands.add_parser("kubeconfig", parents=[common], help="print the path of the kubeconfig")
    node = commands.add_parser(
        "node",
        parents=[common],
        help="cause or end a fault of a node: " + "; ".join(f"{name}: {text}" for name, (text, _) in _FAULTS.items()),
    )
    node.add_argument("action", choices=list(_FAULTS))
    node.add_argument("node")
    _add_network(commands.add_parser("network", parents=[common], help="give a node's network modes: see --help"))
    api = commands.add_parser("api", parents=[common], help="stop: end only the API server; start: start it again")
    api.add_argument("action", choices=list(_API))
    return top


def _add_network(network: argparse.ArgumentParser) -> None:
    network.description = (
        "Give a node's network these modes and no others, while it runs. Without options it works as it should again, and so it does "
        "after `up` and `node up`."
    )
    network.add_argument("node")
    network.add_argument(
        "--established",
        action="store_true",
        help="flows live on of which a packet was let through before, until their pod is deleted",
    )
    network.add_argument("--deaf", action="store_true", help="no change of the cluster is applied until this mode ends")
    network.add_argument(
        "--lag", type=int, default=0, metavar="MILLISECONDS", help="each change is applied so much later"
    )
    network.add_argument(
        "--keep-vanished",
        action="store_true",
        help="a pod whose object is deleted before its network keeps what it was allowed last",
    )
    network.add_argument(
        "--label-lag",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="changes of the labels of pods and namespaces are applied so much later, and no policy of these pods changes until then",
    )


def _network_modes(options: argparse.Namespace) -> NetworkModes:
    return NetworkModes(options.established, options.deaf, options.lag, options.keep_vanished, options.label_lag)


def main(arguments: list[str] | None = None) -> int:
    """Run the command, and return the exit code."""
    options = parser().parse_args(arguments)
    progress = Progress()
    try:
        provider = select(options.provider, options.name, progress, getattr(options, "network", None))
        if options.command == "up":
            provider.up()
        elif options.command == "down":
            provider.down()
        elif options.command == "load-image":
            provider.load_images(options.image)
        elif options.command == "kubeconfig":
            print(provider.kubeconfig())
        elif options.command == "node":
            _FAULTS[options.action][1](provider, options.node)
        elif options.command == "network":
            provider.node_network(options.node, _network_modes(options))
        elif options.command == "api":
            _API[options.action](provider)
        else:
            status = provider.status()
            print("\n".join([status.summary, *(f"  {line}" for line in status.details)]))
            return 0 if status.ready else 1
    except (ClusterError, RuntimeError, TimeoutError, ValueError) as error:
        print(f"scripts/cluster {options.command}: {error}", file=sys.stderr)
        return 1
    return 0
