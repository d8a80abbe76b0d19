"""Stand-ins for the programs `kind` and `docker` on one machine: kind's nodes are containers of this Docker.

They record how they are called, accept only what the real ones accept, and answer in the same words: kind 0.31, Docker 28.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

KUBECTL = ("kubectl", "--kubeconfig=/etc/kubernetes/admin.conf")
"""How the provider calls kubectl in the control plane."""

SYSTEM_CALLS = {
    ("systemctl", "start", "containerd", "kubelet"): True,
    ("systemctl", "stop", "containerd", "kubelet"): False,
}
_PROGRAM = """#!{python} -IS
import sys
sys.path.insert(0, {folder!r})
import fake_kind
fake_kind.main({program!r}, {state!r}, sys.argv[1:])
"""


class Container(TypedDict):
    """A node of kind."""

    cluster: str
    status: str
    """As `docker inspect` has it: running, paused or exited."""
    networks: list[str]
    runtime: bool
    """Whether containerd and kubelet run in it."""


class State(TypedDict):
    """What the stand-ins know."""

    containers: dict[str, Container]
    images: dict[str, str]
    joined: list[str]
    """Nodes that Kubernetes has."""
    cordoned: list[str]
    refusals: int
    """How many more calls the API server refuses, as it does while it starts."""
    initialized: bool
    """Whether kubeadm made the control plane's files."""
    config: str
    """The last configuration that kind was given."""
    broken: dict[str, str]
    """Beginnings of command lines that fail, each with what is printed."""


class FakeKind:
    """Controls the stand-ins, and reads their calls."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._state = folder / "state.json"
        self.state: State = {
            "containers": {}, "images": {}, "joined": [], "cordoned": [], "refusals": 0, "initialized": True, "config": "", "broken": {},
        }  # fmt: skip
        self.save()
        for program in ("kind", "docker"):
            self.add(program)

    def add(self, program: str) -> None:
        """Put a program into the folder."""
        path, here = self.folder / program, str(Path(__file__).parent)
        path.write_text(_PROGRAM.format(python=sys.executable, folder=here, program=program, state=str(self._state)))
        path.chmod(0o755)

    def remove(self, program: str) -> None:
        """Take a program away."""
        (self.folder / program).unlink()

    def save(self) -> None:
        """Let changes of `state` apply."""
        self._state.write_text(json.dumps(self.state))

    def load(self) -> State:
        """Return the present state, which can be changed until `save`."""
        self.state = json.loads(self._state.read_text())
        return self.state

    def create_cluster(self, name: str, config: Path, kubeconfig: Path) -> None:
        """Let there be a cluster, as kind makes it."""
        _create_cluster(self.state, argparse.Namespace(name=name, config=config, kubeconfig=kubeconfig))
        self.save()

    def break_command(self, beginning: str, message: str) -> None:
        """Let commands fail that begin with these words."""
        self.load()["broken"][beginning] = message
        self.save()

    def stop_docker(self) -> None:
        """Let Docker's daemon not run."""
        no_daemon = "Cannot connect to the Docker daemon at unix:///var/run/docker.sock. Is the docker daemon running?"
        self.break_command("docker", no_daemon)
        self.break_command(
            "kind", f'ERROR: failed to list clusters: command "docker ps" failed\n\nCommand Output: {no_daemon}'
        )

    def change(self, container: str, **fields: Any) -> None:
        """Change fields of a container."""
        self.load()["containers"][container].update(fields)  # type: ignore[typeddict-item]
        self.save()

    def container(self, name: str) -> Container:
        """Return a container as it is now."""
        return self.load()["containers"][name]

    def calls(self, beginning: str = "") -> list[str]:
        """Return the command lines so far that begin with these words."""
        log = self._state.with_suffix(".calls")
        lines = log.read_text().splitlines() if log.exists() else []
        return [line for line in lines if line.startswith(beginning)]


class _Failed(Exception):
    """The program ends with 1 and prints this."""


def main(program: str, state: str, arguments: Sequence[str]) -> None:
    """Be one of the programs for one call."""
    path = Path(state)
    line = shlex.join([program, *arguments])
    with path.with_suffix(".calls").open("a") as log:
        print(line, file=log)
    known: State = json.loads(path.read_text())
    try:
        for beginning, message in known["broken"].items():
            if line.startswith(beginning):
                raise _Failed(message)
        (_kind if program == "kind" else _docker)(known, list(arguments))
    except _Failed as failed:
        print(failed, file=sys.stderr)
        sys.exit(1)
    finally:
        path.write_text(json.dumps(known))


def _kind(state: State, arguments: list[str]) -> None:
    command, options = " ".join(arguments[:2]), arguments[2:]
    known: Mapping[str, tuple[Callable[[State, argparse.Namespace], None], tuple[str, ...]]] = {
        "get clusters": (_get_clusters, ()),
        "get nodes": (_get_nodes, ("--name",)),
        "create cluster": (_create_cluster, ("--name", "--config", "--wait", "--kubeconfig")),
        "delete cluster": (_delete_cluster, ("--name", "--kubeconfig")),
        "export kubeconfig": (_export_kubeconfig, ("--name", "--kubeconfig")),
        "load docker-image": (_load_docker_image, ("--name", "image")),
        "load image-archive": (_load_image_archive, ("--name", "image")),
    }
    if command not in known:
        raise _Failed(f'ERROR: unknown command "{command}" for "kind"')
    answer, accepted = known[command]
    parser = argparse.ArgumentParser(prog=f"kind {command}", allow_abbrev=False)
    for option in accepted:
        parser.add_argument(option)
    answer(state, parser.parse_args(options))


def _nodes_of(state: State, cluster: str) -> list[str]:
    return [name for name, container in state["containers"].items() if container["cluster"] == cluster]


def _get_clusters(state: State, options: argparse.Namespace) -> None:
    clusters = sorted({container["cluster"] for container in state["containers"].values()})
    if not clusters:
        print("No kind clusters found.", file=sys.stderr)
    for cluster in clusters:
        print(cluster)


def _get_nodes(state: State, options: argparse.Namespace) -> None:
    nodes = _nodes_of(state, options.name)
    if not nodes:
        print(f'No kind nodes found for cluster "{options.name}".', file=sys.stderr)
    for node in nodes:
        print(node)


def _create_cluster(state: State, options: argparse.Namespace) -> None:
    if _nodes_of(state, options.name):
        already = f'node(s) already exist for a cluster with the name "{options.name}"'
        raise _Failed(f"ERROR: failed to create cluster: {already}")
    state["config"] = Path(options.config).read_text()
    counts: dict[str, int] = {}
    for role in re.findall(r"^- role: (\S+)$", state["config"], re.MULTILINE):
        counts[role] = counts.get(role, 0) + 1
        name = f"{options.name}-{role}{counts[role] if counts[role] > 1 else ''}"
        state["containers"][name] = {
            "cluster": options.name,
            "status": "running",
            "networks": ["kind"],
            "runtime": True,
        }
    state["joined"], state["initialized"] = _nodes_of(state, options.name), True
    print(f'Creating cluster "{options.name}" ...\n • Ready after 0s', file=sys.stderr)
    _export_kubeconfig(state, options)


def _delete_cluster(state: State, options: argparse.Namespace) -> None:
    print(f'Deleting cluster "{options.name}" ...', file=sys.stderr)
    for node in _nodes_of(state, options.name):
        del state["containers"][node]
    if Path(options.kubeconfig).exists():
        Path(options.kubeconfig).write_text("{}\n")  # kind takes its own entries out, and leaves the file


def _export_kubeconfig(state: State, options: argparse.Namespace) -> None:
    if not _nodes_of(state, options.name):
        raise _Failed(f"ERROR: could not locate any control plane nodes for cluster named '{options.name}'")
    path = Path(options.kubeconfig)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"current-context": f"kind-{options.name}"}))
    print(f'Set kubectl context to "kind-{options.name}"', file=sys.stderr)


def _load_docker_image(state: State, options: argparse.Namespace) -> None:
    if options.image not in state["images"]:
        raise _Failed(f'ERROR: image: "{options.image}" not present locally')
    _load_image_archive(state, options)


def _load_image_archive(state: State, options: argparse.Namespace) -> None:
    if not _nodes_of(state, options.name):
        raise _Failed(f'ERROR: no nodes found for cluster "{options.name}"')


def _docker(state: State, arguments: list[str]) -> None:
    match arguments:
        case ["version", "--format", "{{.Server.Version}}"]:
            print("28.2.2")
        case ["image", "inspect", "--format", "{{.Id}}", name]:
            if name not in state["images"]:
                raise _Failed(f"Error response from daemon: No such image: {name}")
            print(state["images"][name])
        case ["container", "inspect", name]:
            found = _find(state, name)
            networks: dict[str, dict[str, str]] = {network: {} for network in found["networks"]}
            described = {"State": {"Status": found["status"]}, "NetworkSettings": {"Networks": networks}}
            print(json.dumps([{"Name": f"/{name}", **described}]))
        case ["exec", name, *command]:
            _exec(state, name, tuple(command))
        case ["network", ("connect" | "disconnect") as action, "kind", name]:
            _network(name, _find(state, name), action)
        case [("start" | "kill" | "pause" | "unpause") as action, name]:
            _change_status(name, _find(state, name), action)
            print(name)
        case _:
            raise _Failed(f"docker: unknown command: docker {' '.join(arguments)}")


def _find(state: State, name: str) -> Container:
    if name not in state["containers"]:
        raise _Failed(f"Error response from daemon: No such container: {name}")
    return state["containers"][name]


def _network(name: str, container: Container, action: str) -> None:
    networks = container["networks"]
    if action == "disconnect":
        if "kind" not in networks:
            raise _Failed(f"Error response from daemon: container {name} is not connected to network kind")
        networks.remove("kind")
    elif "kind" not in networks:
        networks.append("kind")
    elif container["status"] != "exited":
        raise _Failed(f"Error response from daemon: endpoint with name {name} already exists in network kind")


def _change_status(name: str, container: Container, action: str) -> None:
    status = container["status"]
    refused = {
        ("start", "paused"): "cannot start a paused container, try unpause instead",
        ("kill", "exited"): f"cannot kill container: {name}: container {name} is not running",
        ("pause", "exited"): f"container {name} is not running",
        ("pause", "paused"): f"container {name} is already paused",
        ("unpause", "running"): f"Container {name} is not paused",
        ("unpause", "exited"): f"Container {name} is not paused",
    }
    if (action, status) in refused:
        raise _Failed(f"Error response from daemon: {refused[action, status]}")
    if action == "start" and status == "exited":
        # The first program of a node of kind ends with an error if the node had an address and has none any more.
        container["status"] = "running" if container["networks"] else "exited"
        container["runtime"] = True
    elif action != "start":
        container["status"] = {"kill": "exited", "pause": "paused", "unpause": "running"}[action]


def _exec(state: State, name: str, command: tuple[str, ...]) -> None:
    container = _find(state, name)
    if container["status"] == "paused":
        raise _Failed(f"Error response from daemon: Container {name} is paused, unpause the container before exec")
    if container["status"] != "running":
        raise _Failed(f"Error response from daemon: container {name} is not running")
    if command[:2] == KUBECTL:
        _kubectl(state, command[2:])
    elif command in SYSTEM_CALLS:
        container["runtime"] = SYSTEM_CALLS[command]
    else:
        raise _Failed(f'OCI runtime exec failed: exec failed: exec: "{command[0]}": executable file not found in $PATH')


def _kubectl(state: State, arguments: tuple[str, ...]) -> None:
    if not state["initialized"]:
        raise _Failed("error: stat /etc/kubernetes/admin.conf: no such file or directory")
    if state["refusals"]:
        state["refusals"] -= 1
        raise _Failed(
            "The connection to the server understudy-control-plane:6443 was refused - did you specify the right host or port?"
        )
    match arguments:
        case ["get", "nodes", "-o", "name"]:
            print("\n".join(f"node/{node}" for node in state["joined"]))
        case ["get", "nodes", "--no-headers"]:
            for node in state["joined"]:
                role = "control-plane" if node.endswith("-control-plane") else "<none>"
                cordoned = ",SchedulingDisabled" if node in state["cordoned"] else ""
                readiness = "Ready" if _ready(state, node) else "NotReady"
                print(f"{node:<26}   {readiness + cordoned:<8}   {role:<15}   61s   v1.35.0")
        case ["wait", "--for=condition=Ready", "nodes", "--all", _]:
            for node in state["joined"]:
                if not _ready(state, node):
                    raise _Failed(f"error: timed out waiting for the condition on nodes/{node}")
                print(f"node/{node} condition met")
        case ["-n", "kube-system", "rollout", "status", "deployment/coredns", _]:
            print('deployment "coredns" successfully rolled out')
        case _:
            raise _Failed(f"error: unknown command {' '.join(arguments)}")


def _ready(state: State, node: str) -> bool:
    container = state["containers"][node]
    return container["status"] == "running" and "kind" in container["networks"] and container["runtime"]
