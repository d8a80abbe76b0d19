"""``understudy init deployment/NAME``: writes the manifests that protect an application, and explains each choice."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from understudy.cli.check.command import check
from understudy.cli.common import option_rules
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.init import observed_topics
from understudy.cli.init.application import Application, Reference, from_cluster, from_files, reference
from understudy.cli.init.observed_topics import Observed
from understudy.cli.init.written_files import GAP, OBJECTS, Draft, GateKind, files, next_steps
from understudy.cli.simulate.command_topics import command_topics
from understudy.cli.simulate.learn import leaf_lines, learned_leaf
from understudy.ros.rmw import MIDDLEWARE


@reports_errors("init")
def main(arguments: list[str]) -> int:
    """Run the command. The objects go to standard output, or all files into a folder."""
    options = _parser().parse_args(arguments)
    application = _read(options, options.application)
    _refuse(application)
    draft = _draft(options, application)
    written = files(draft)
    _check(written)
    if options.write is None:
        print(written[OBJECTS], end="")
    else:
        _write(Path(options.write), written)
    folder = (options.write or "FOLDER").rstrip("/")
    note = "next" if options.write else "with --write FOLDER, it also writes the patches; then"
    print(
        "\n".join([f"understudy init: {note}:", *(f"  {step}" for step in next_steps(draft, folder, written))]),
        file=sys.stderr,
    )
    return 0


def _read(options: argparse.Namespace, wanted: Reference) -> Application:
    """Return a Deployment or StatefulSet of the files, or of the cluster. Raises CommandError."""
    if options.filename:
        return from_files(options.filename, wanted)
    return from_cluster(Kubectl(options).get, wanted)


def _refuse(application: Application) -> None:
    """Raise CommandError if it cannot be protected as it is."""
    name = f"{application.kind} {application.name}"
    if application.replicas != 1:
        raise CommandError(
            f"{name} has {application.replicas} replicas, and one robot is driven by one pod: set replicas to 1. A FallbackPool runs others"
        )
    rmw = application.environment.get("RMW_IMPLEMENTATION", MIDDLEWARE.implementation)
    if rmw != MIDDLEWARE.implementation:
        raise CommandError(f"{name} uses {rmw}, and only {MIDDLEWARE.name} ({MIDDLEWARE.implementation}) is supported")


def _draft(options: argparse.Namespace, application: Application) -> Draft:
    gate: GateKind = options.gate or ("Mux" if application.uses_host_network else "NetworkPolicy")
    if gate == "NetworkPolicy" and application.uses_host_network:
        raise CommandError(
            f"{application.kind} {application.name} uses the network of its node, which no NetworkPolicy applies to: use --gate Mux"
        )
    if options.image and gate != "Mux":
        raise CommandError(f"--image is that of a mux, which there is only with --gate Mux, and not with {gate}")
    given = dict(options.outputs)
    observed = _observe(options, [*given, *options.watch])
    outputs = _outputs(given, observed)
    watched = list(dict.fromkeys([*(topic for topic, _ in outputs), *options.watch]))
    return Draft(
        name=options.name or application.name,
        namespace=options.namespace or "",
        application=application,
        robot=_read(options, options.robot) if options.robot else None,
        outputs=outputs,
        leaves=[_leaf(topic, dict(outputs), observed) for topic in watched],
        gate=gate,
        readiness=options.readiness,
        image=options.image or "",
        source=observed.source if observed is not None else "",
    )


def _observe(options: argparse.Namespace, named: Sequence[str]) -> Observed | None:
    """Measure the named topics and those that look like commands; None if there is nothing to measure."""

    def choice(types: Mapping[str, str]) -> list[str]:
        return [*named, *command_topics(types)]

    if options.bag:
        return observed_topics.in_bag(options.bag, choice)
    if options.live is not None:
        print(f"understudy init: listening for {options.live:g} s", file=sys.stderr)
        return observed_topics.in_graph(options.live, choice)
    return None


def _outputs(given: Mapping[str, str], observed: Observed | None) -> list[tuple[str, str]]:
    """Return the output topics with their types. Raises CommandError if they are unknown."""
    types = observed.types if observed is not None else {}
    if given:
        for topic, type_name in given.items():
            if not type_name and topic not in types:
                where = f"is not in {observed.source}" if observed is not None else "has no type"
                raise CommandError(f"output {topic} {where}: give its type, such as {topic}=geometry_msgs/msg/Twist")
        return [(topic, type_name or types[topic]) for topic, type_name in given.items()]
    found = command_topics(types)
    if len(found) == 1:
        return [(found[0], types[found[0]])]
    if not found:
        seen = f": {observed.source} has {', '.join(sorted(types)) or 'no topic'}" if observed is not None else ""
        raise CommandError(
            "name with --output each topic with which the application acts on the robot, such as "
            f"--output /cmd_vel=geometry_msgs/msg/Twist, or measure it with --bag or --live{seen}"
        )
    raise CommandError(
        f"{', '.join(found)} look like commands: name with --output those that the robot itself reads, and not those between the "
        "application's own nodes"
    )


def _leaf(topic: str, outputs: Mapping[str, str], observed: Observed | None) -> list[str]:
    """Return the lines of a topic's leaf in the health tree."""
    if observed is None:
        return [
            "# Not measured: longer than the longest gap of healthy operation.",
            f"- topic: {{name: {topic}, gap: {GAP}}}",
        ]
    type_name = outputs.get(topic) or observed.types.get(topic, "")
    if not type_name:
        raise CommandError(f"{topic} is not in {observed.source}")
    return list(leaf_lines(*learned_leaf(observed.source, topic, type_name, observed.arrivals.get(topic, ()))))


def _check(written: Mapping[str, str]) -> None:
    """Raise CommandError with the first error of ``understudy check``, such as an invalid name."""
    result = check([(OBJECTS, written[OBJECTS].encode())])
    if result.errors:
        first = next(one for one in result.findings if one.severity == "error")
        raise CommandError(f"{first.subject}: {first.field}: {first.message}")


def _write(folder: Path, written: Mapping[str, str]) -> None:
    """Write the files. Raises CommandError, also if one exists: somebody may have edited it."""
    for path in written:
        if (folder / path).exists():
            raise CommandError(f"{folder / path} exists already: remove it, or give another folder")
    try:
        for path, text in written.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
            print(folder / path)
    except OSError as error:
        raise CommandError(f"cannot write to {folder}: {error}") from error


def _output(text: str) -> tuple[str, str]:
    topic, _, type_name = text.partition("=")
    if not topic.startswith("/"):
        raise argparse.ArgumentTypeError(f"found {text!r:.60}; give a topic with its full name, such as /cmd_vel")
    return topic, type_name


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy init",
        description="Writes a RobotWorkload, a FailurePolicy and a FallbackPool for a Deployment or StatefulSet that drives a robot, and "
        "patches with which application and robot join the robot's ROS graph. Comments explain each choice. The bounds of the health "
        "tree come from a recording of a healthy robot, or from the live ROS graph. The command changes nothing in the cluster.",
        epilog="Exit status: 0 if the manifests were written, 2 on an error.",
    )
    option_rules.add_examples(
        parser,
        "understudy init deployment/nav2 --robot deployment/base -n fleet --bag drive/ --write robot-17/",
        "understudy init deployment/nav2 -f nav2.yaml --output /cmd_vel=geometry_msgs/msg/Twist",
    )
    parser.add_argument(
        "application", metavar="KIND/NAME", type=reference, help="what drives the robot, such as deployment/nav2"
    )
    parser.add_argument(
        "--robot",
        metavar="KIND/NAME",
        type=reference,
        help="what runs the robot's drivers in the cluster, if anything does",
    )
    parser.add_argument(
        "-f", "--filename", metavar="FILE", action="append", help="read both from manifests instead of the cluster"
    )
    parser.add_argument("--name", help="name of the three objects (default: that of the application)")
    parser.add_argument(
        "--output", metavar="TOPIC[=TYPE]", dest="outputs", type=_output, action="append", default=[],
        help="a topic with which the application acts on the robot; may be given several times (default: the only one that was observed "
        "and looks like commands)",
    )  # fmt: skip
    parser.add_argument(
        "--watch",
        metavar="TOPIC",
        action="append",
        default=[],
        help="a further topic that shows whether the application is healthy; may be given several times",
    )
    seen = parser.add_mutually_exclusive_group()
    seen.add_argument("--bag", metavar="BAG", help="learn from a rosbag2 folder, or an .mcap or .db3 file")
    seen.add_argument(
        "--live",
        metavar="DURATION",
        type=option_rules.duration,
        help="learn from the ROS graph that the environment selects, for this time, such as 60s",
    )
    parser.add_argument(
        "--readiness",
        choices=["Executing", "Uninitialized"],
        default="Executing",
        help="how far an understudy is prepared (default: Executing)",
    )
    parser.add_argument(
        "--gate",
        choices=["NetworkPolicy", "Mux"],
        help="kind of the gate (default: NetworkPolicy, or Mux for an application in the network of its node)",
    )
    parser.add_argument(
        "--image", help="image of the mux with --gate Mux: that of the monitor, the chart's value images.monitor"
    )
    parser.add_argument(
        "--write", metavar="FOLDER", help="write all files into a folder instead of printing the objects"
    )
    add_options(parser)
    return parser
