"""Finds the container of a mux in a pod, and what it lacks. The pod may be any text that somebody wrote."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any

from understudy.api import names
from understudy.cli.manifests.manifest_reader import at, items

_TOKEN_DIR = str(PurePosixPath(names.MUX_TOKEN_FILE).parent)


def path(spec: object, config_map: str) -> str:
    """Return the path of the container below a pod's spec that has the environment of a ConfigMap, or as one of several workloads a folder
    with it; empty if none has.
    """
    found = (
        where for where, one in _containers(spec) if _has_environment(one, config_map) or _folder(spec, one, config_map)
    )
    return next(found, "")


def problems(spec: object, workload: str) -> Iterator[str]:
    """Yield what the mux of a workload lacks in a pod, as sentences."""
    mux = names.mux(workload)
    place = path(spec, mux)
    container = next((one for where, one in _containers(spec) if where == place), None)
    if container is None:
        return
    is_folder = not _has_environment(container, mux)
    if is_folder:  # the workloads of a robot have one ROS graph
        if not any(_is_robot_env(at(one, "configMapRef", "name")) for one in items(container, "envFrom")):
            yield (
                "the mux does not join the robot's ROS graph, because it lacks the environment for that: add ConfigMap "
                f"{names.robot_env(workload)} to envFrom"
            )
    elif not _has_environment(container, names.robot_env(workload)):
        yield (
            f"the mux does not join the robot's ROS graph, because it lacks the environment of ConfigMap {names.robot_env(workload)}: add "
            "it to envFrom"
        )
    mounted = {
        at(one, "name"): str(at(one, "mountPath")).rstrip("/")
        for one in items(container, "volumeMounts")
        if isinstance(at(one, "name"), str)
    }
    variables = {at(one, "name") for one in items(container, "env") if isinstance(at(one, "name"), str)}
    if is_folder:
        if mux not in (at(one, "secret", "name") for one in _folder(spec, container, mux)):
            yield f"the mux has no token for this workload: add Secret {mux} to the volume with ConfigMap {mux}"
    else:
        secrets = [at(one, "name") for one in items(spec, "volumes") if at(one, "secret", "secretName") == mux]
        is_mounted = any(isinstance(one, str) and mounted.get(one) == _TOKEN_DIR for one in secrets)
        if names.MUX_TOKEN_VARIABLE not in variables and not is_mounted:
            yield f"the mux has no token: mount a volume with Secret {mux} at {_TOKEN_DIR}"
    if names.MUX_STATE_VARIABLE not in variables and names.STATE_DIR not in mounted.values():
        yield (
            f"the mux forgets whom it forwards when its container restarts, and forwards nobody until the monitor's next order: mount a "
            f"volume at {names.STATE_DIR}"
        )


def forgotten(spec: object, workload: str) -> str:
    """Return what keeps containers beside an instance on board from starting again while the link to the cluster is down; empty if nothing.

    The kubelet forgets a ConfigMap that only an environment needs five minutes after it was last read. It asks for one in a volume every
    minute, and keeps the last answer.
    """
    containers = [one for _, one in _containers(spec)]
    if not any(_has_environment(one, names.on_board(workload)) for one in containers):
        return ""
    needed = [at(one, "configMapRef", "name") for container in containers for one in items(container, "envFrom")]
    sources = [
        *items(spec, "volumes"),
        *(one for volume in items(spec, "volumes") for one in items(volume, "projected", "sources")),
    ]
    kept = [at(one, "configMap", "name") for one in sources]
    lacking = sorted({one for one in needed if isinstance(one, str) and one not in kept})
    if not lacking:
        return ""
    return (
        f"no volume has {'ConfigMap' if len(lacking) == 1 else 'ConfigMaps'} {', '.join(lacking)}, which the kubelet forgets "
        "when its node has been cut off for five minutes. A container that ends after that does not start again: mount a volume "
        "with each ConfigMap that envFrom names, as volume settings in examples/quickstart/manifests/mux/on-board/robot.yaml"
    )


def _containers(spec: object) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in ("containers", "initContainers"):
        for number, one in enumerate(items(spec, kind)):
            if isinstance(one, Mapping):
                yield f"{kind}[{number}]", one


def _folder(spec: object, container: object, config_map: str) -> list[object]:
    """Return the sources of the projected volume with a ConfigMap that a container mounts as the folder of one workload; else nothing."""
    mounted = [
        at(one, "name")
        for one in items(container, "volumeMounts")
        if str(PurePosixPath(str(at(one, "mountPath"))).parent) == names.MUX_FOLDER
    ]
    for volume in items(spec, "volumes"):
        sources = items(volume, "projected", "sources")
        if at(volume, "name") in mounted and config_map in (at(one, "configMap", "name") for one in sources):
            return sources
    return []


def _is_robot_env(name: object) -> bool:
    return isinstance(name, str) and name.endswith(names.robot_env(""))


def _has_environment(container: object, config_map: str) -> bool:
    return any(at(one, "configMapRef", "name") == config_map for one in items(container, "envFrom"))
