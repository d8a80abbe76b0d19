"""``understudy robot-profile NAME``: prints the files with which a robot outside the cluster reads its outputs behind the gate."""

from __future__ import annotations

import argparse
from pathlib import Path

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.output_formats import structured
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_options, add_robot
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.control.mux_files import MuxFiles
from understudy.cli.control.profile_files import ENV_FILE, PROFILES_FILE, Profile, RobotFiles
from understudy.controller.pods.ros_environment import PROFILES_DIR
from understudy.kube.client import Object


@reports_errors("robot-profile")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    kubectl = Kubectl(options)
    found = _profile(kubectl, kubectl.get(WORKLOADS, options.name), options.at)
    if options.write:
        _write(found, Path(options.write))
        print("\n".join(found.advice()))
    elif options.output in ("json", "yaml"):
        print(structured(found.to_wire(), options.output))
    elif options.output == "text":
        print("\n".join(found.lines()))
    else:
        print(_file(found, ENV_FILE if options.output == "env" else PROFILES_FILE), end="")
    return 0


def _file(found: RobotFiles, name: str) -> str:
    if name not in found.files:
        raise CommandError(
            f"the robot of {found.name} needs no {name}, because a mux forwards the outputs: {', '.join(found.files)}"
        )
    return found.files[name]


def _profile(kubectl: Kubectl, item: Object, folder: str | None) -> RobotFiles:
    """Read the ConfigMaps that the operator keeps for the robot's side. Raises CommandError."""
    name = item["metadata"]["name"]
    environment = _data(kubectl, name, names.robot_env(name))
    try:
        spec = RobotWorkloadSpec.model_validate(item["spec"])
    except ValidationError as error:
        raise CommandError(
            f"RobotWorkload {name} is of another version of Understudy: see understudy doctor"
        ) from error
    namespace = item["metadata"]["namespace"]
    if spec.gate.is_at_robot:
        settings = _data(kubectl, name, names.mux(name))
        return MuxFiles(name, namespace, spec, environment, folder or f"{PROFILES_DIR}/{name}", settings)
    profiles = _data(kubectl, name, names.robot_profiles(name))[names.PROFILES_KEY]
    return Profile(name, namespace, spec, environment, folder or PROFILES_DIR, profiles)


def _data(kubectl: Kubectl, workload: str, name: str) -> dict[str, str]:
    found = kubectl.find("configmaps", name)
    if found is None:
        raise CommandError(f"ConfigMap {name} does not exist yet: understudy explain {workload} says what it waits for")
    data: dict[str, str] = found["data"]
    return data


def _write(found: RobotFiles, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in found.files.items():
            (folder / name).write_text(text)
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error}") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy robot-profile",
        description="Prints the environment variables and the DDS profiles for the processes of a robot outside "
        "the cluster. With these, the processes join the robot's ROS graph and read the outputs at gated ports. With gate kind Mux, "
        "they need no profiles, and the second file is the environment of the mux instead. "
        "Also prints where to put the two files, and what else the robot needs. It changes nothing.",
        epilog="Exit status: 0 on success, 2 on an error, for example if the files do not exist yet.",
    )
    add_examples(
        parser, "understudy robot-profile robot-1 -n fleet", "understudy robot-profile robot-1 --write robot-1/"
    )
    add_robot(parser)
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "-o",
        "--output",
        choices=["text", "env", "xml", "json", "yaml"],
        default="text",
        help="text; env: only the environment variables, as a file; xml: only the DDS profiles; or everything as "
        "JSON or YAML",
    )
    how.add_argument("--write", metavar="FOLDER", help="write both files into a folder of this machine")
    parser.add_argument(
        "--at",
        metavar="FOLDER",
        help=f"folder of the two files on the robot (default: {PROFILES_DIR}, or {PROFILES_DIR}/NAME with gate kind Mux)",
    )
    add_options(parser)
    return parser
