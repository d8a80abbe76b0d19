"""Requests a planned switchover and waits for its end: ``understudy failover NAME`` and ``understudy failback NAME``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.api.kinds.switchover_spec import ENDED, SwitchoverStatus, Verb, request
from understudy.api.plain_text import plain
from understudy.cli.common import confirmation, option_rules
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_dry_run, add_options, add_robot
from understudy.cli.common.errors import CommandError
from understudy.cli.common.robots import UNWATCHED, robot, status_of
from understudy.cli.common.text import terminal
from understudy.cli.common.text.time_bars import length, short
from understudy.cli.common.text.wording import unix, wrapped

DONE, NOT_DONE = 0, 1
"""Exit statuses besides ERROR."""

WORKLOADS = "robotworkloads.understudy.dev"

WITHIN = 120.0
"""Default seconds to wait for its end: longer than a monitor waits for an understudy to become ready."""

CHECK_PERIOD = 1.0
"""Seconds between two requests without a change."""

_PURPOSE: Mapping[Verb, str] = {
    "failover": "Switches a RobotWorkload to another instance although nothing failed (a planned switchover). The "
    "new instance (the understudy) first becomes ready and receives the state of the active one. Then the monitor "
    "switches the gate. When the monitor has verified the outputs of the new instance at the robot, it deletes the "
    "pod of the former one. If no instance becomes ready, nothing changes.",
    "failback": "Switches a RobotWorkload back to a pod of its Deployment, StatefulSet or (with spec.template) "
    "ReplicaSet, after a pool's pod has taken over. This is also a planned switchover, and works as understudy "
    "failover does.",
}


def run(verb: Verb, arguments: list[str]) -> int:
    """Run the command."""
    options = _parser(verb).parse_args(arguments)
    kubectl = Kubectl(options)
    _refuse(kubectl.get(WORKLOADS, options.name))
    confirmation.confirm(
        f"{options.name} controls a robot, which receives the commands of another instance from the switch on. Switch?",
        yes=options.yes or kubectl.dry_run,
    )
    return _switch(verb, kubectl, options.name, options.within)


def _switch(verb: Verb, kubectl: Kubectl, name: str, within: float) -> int:
    columns = terminal.columns(sys.stdout)
    asked, started_at = request(verb, time.time()), time.monotonic()
    reported: tuple[str, str] = ("", "")
    try:
        with kubectl.changes(WORKLOADS, name) as changed:
            kubectl.annotate(WORKLOADS, name, names.SWITCHOVER, asked)
            print(kubectl.shown("requested"), flush=True)
            if kubectl.dry_run:
                return DONE
            while time.monotonic() - started_at < within:
                status = status_of(kubectl.get(WORKLOADS, name))
                found = status.switchover
                if found is not None and found.request == asked:
                    if found.phase in ENDED:
                        print("\n".join(_end(found, status, columns)))
                        return DONE if found.phase == "Done" else NOT_DONE
                    if (found.phase, found.message) != reported:
                        reported = (found.phase, found.message)
                        print(
                            "\n".join(wrapped(f"{found.phase.lower()}: {found.message}", columns, indent=0, hanging=2)),
                            flush=True,
                        )
                elif found is not None and found.handled == asked:
                    raise CommandError(
                        f"the switchover has ended, and another one has started since: understudy timeline {name}"
                    )
                changed(CHECK_PERIOD)
    except KeyboardInterrupt:
        print("", file=sys.stderr)
    how_far = reported[0].lower() or "its monitor has not started it"
    raise CommandError(
        f"the switchover has not ended ({how_far}) and continues without this command. To withdraw the request: "
        f"kubectl annotate robotworkload {name} {names.SWITCHOVER}-"
    )


def _refuse(item: Mapping[str, Any]) -> None:
    """Raise CommandError if no monitor would carry out the request, or if another switchover is under way."""
    name, status = item["metadata"]["name"], status_of(item)
    if robot(item).health == UNWATCHED:
        raise CommandError(f"the monitor of {name} is not running and cannot carry it out: understudy explain {name}")
    found = status.switchover
    if found is not None and found.request and found.phase not in ENDED:
        raise CommandError(f'"{plain(found.request)}" is under way ({found.phase.lower()}: {plain(found.message)})')


def _end(found: SwitchoverStatus, status: RobotWorkloadStatus, columns: int | None) -> Iterator[str]:
    """Format the result, and what the robot received meanwhile."""
    recovery = next((one for one in status.recoveries or [] if one.id == found.recovery), None)
    done = found.phase == "Done"
    if recovery is None or not done:
        yield from wrapped(f"{'done' if done else 'NOT done'}: {found.message}", columns, indent=0, hanging=2)
        return
    pods = short([recovery.from_pod, recovery.to_pod])
    control = f"{pods[recovery.from_pod]} → {pods[recovery.to_pod]} by {recovery.strategy}, gate epoch {recovery.epoch}"
    yield from wrapped(f"done: {control}", columns, indent=0, hanging=2)
    yield from wrapped(f"at the robot: {'; '.join(_at_the_robot(recovery))}", columns, indent=2)
    for entry in recovery.state:
        old = f", {length(entry.age_seconds)} old" if entry.age_seconds is not None else ""
        result = f"restored{old}" if entry.restored else f"NOT restored: {entry.message}"
        yield from wrapped(f"state: {entry.name} {result}", columns, indent=2)


def _at_the_robot(recovery: Recovery) -> Iterator[str]:
    """Describe what the monitor received on the robot's topics."""
    moments = recovery.moments
    if moments.first_output is None:
        yield "no outputs were observed, because no monitored topic has outputs at present"
        return
    if moments.last_output is None:
        yield "outputs of the new instance arrive; it was not observed when the last one of the former instance did"
    else:
        yield f"no command for {length(max(0.0, unix(moments.first_output) - unix(moments.last_output)))}"
        if moments.fenced is not None and unix(moments.last_output) > unix(moments.fenced) + 0.01:
            late = length(unix(moments.last_output) - unix(moments.fenced))
            yield f"commands of the former instance still arrived {late} after the switch: see condition GateEnforced"


def _parser(verb: Verb) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"understudy {verb}",
        description=_PURPOSE[verb],
        epilog="Exit status: 0 if the switchover succeeded, 1 if it failed and the former instance keeps control, "
        "2 if the command did not see the end, or on another error.",
    )
    option_rules.add_examples(
        parser, f"understudy {verb} robot-1 -n fleet", f"understudy {verb} robot-1 --yes --within 30s"
    )
    add_robot(parser)
    parser.add_argument(
        "--within",
        metavar="DURATION",
        type=option_rules.duration,
        default=WITHIN,
        help="how long the command waits for the end of the switchover, such as 30s (default: 2m); after this time, the switchover "
        "continues without the command",
    )
    confirmation.add_option(parser)
    add_dry_run(parser)
    add_options(parser)
    return parser
