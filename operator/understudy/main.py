"""The ``understudy`` command: finds the module of a verb in :data:`VERBS` and runs its ``main``."""

from __future__ import annotations

import contextlib
import gc
import importlib
import logging
import os
import sys
import traceback
from collections.abc import Iterator
from types import ModuleType
from typing import NamedTuple, NoReturn, TextIO

from understudy import __version__


class Verb(NamedTuple):
    """A verb of the command."""

    name: str
    module: str
    """Its ``main`` receives the arguments after the verb and returns the exit status."""
    summary: str
    """One line for ``understudy --help`` and the reference page."""
    group: str = ""
    """Its heading in the help. Without one, the help and shell completion leave it out."""
    in_pods: bool = False
    """Whether only containers that Understudy creates run it."""
    has_options: bool = True
    """False if the environment configures it, so that it parses no arguments."""
    extra: str = ""
    """The extra of the package without which it does not run."""


SEE, ACT, DESIGN, SET_UP = "See", "Act", "Design", "Set up"

# In the order in which people need them.
VERBS = (
    Verb(
        "try", "understudy.cli.local_demo.command", "see a robot survive a frozen application, on this machine", SET_UP
    ),
    Verb("init", "understudy.cli.init.command", "write the manifests for an application that you have", SET_UP),
    Verb("check", "understudy.cli.check.command", "validate manifests without a cluster", SET_UP),
    Verb("status", "understudy.cli.inspect.status", "show all robots: active instance, standbys, problems", SEE),
    Verb(
        "explain", "understudy.cli.inspect.explain", "explain a robot's state and what a failure would trigger now", SEE
    ),
    Verb("timeline", "understudy.cli.inspect.timeline", "show the last recoveries of a robot", SEE),
    Verb("tree", "understudy.cli.inspect.tree", "show the live health tree of a robot", SEE),
    Verb("doctor", "understudy.cli.doctor.command", "check that the cluster provides what Understudy needs", SET_UP),
    Verb("report", "understudy.cli.report.command", "write a report about the recoveries of a period", SEE),
    Verb("blackbox", "understudy.cli.inspect.blackbox", "list or fetch recordings of a robot's failures", SEE),
    Verb("pause", "understudy.cli.control.pause", "suspend automatic recovery of a robot", ACT),
    Verb("resume", "understudy.cli.control.resume", "end a pause and reset the recovery limits", ACT),
    Verb(
        "failover", "understudy.cli.control.failover", "switch a robot to another instance although nothing failed", ACT
    ),
    Verb(
        "failback",
        "understudy.cli.control.failback",
        "switch a robot back to a pod of its Deployment, StatefulSet or template",
        ACT,
    ),
    Verb("fence", "understudy.cli.control.fence", "deny all instances access to a robot", ACT),
    Verb("inject", "understudy.cli.inject.command", "make the active instance fail, if the namespace allows it", ACT),
    Verb(
        "robot-profile",
        "understudy.cli.control.robot_profile",
        "write the DDS profiles, or the settings of a mux, for a robot outside the cluster",
        SET_UP,
    ),
    Verb("simulate", "understudy.cli.simulate.simulate", "evaluate a policy on a recorded bag", DESIGN),
    Verb("watch", "understudy.cli.simulate.watch", "evaluate a policy on a live ROS graph", DESIGN),
    Verb("learn", "understudy.cli.simulate.learn", "measure gaps and rates in a recorded bag", DESIGN),
    Verb("size", "understudy.cli.plan.size", "calculate how many waiting pods a fleet needs in a shared pool", DESIGN),
    Verb("recommend", "understudy.cli.plan.recommend", "recommend strategies for a policy's requirements", DESIGN),
    Verb(
        "mux",
        "understudy.mux.process",
        "forward one instance to the robot, at the robot",
        SET_UP,
        has_options=False,
        extra="ros",
    ),
    Verb("tracker", "understudy.tracker.process", "track robots with a camera"),
    Verb(
        "verify",
        "understudy.controller.runtime.installation_test",
        "test the installation (used by helm test)",
        extra="operator",
    ),
    Verb("completion", "understudy.cli.completion.command", "print the completion script of a shell", SET_UP),
    Verb(
        "operator",
        "understudy.controller.runtime.process",
        "reconcile the objects of the cluster",
        in_pods=True,
        extra="operator",
    ),
    Verb(
        "monitor",
        "understudy.monitor.process",
        "watch one workload and recover it",
        in_pods=True,
        has_options=False,
        extra="ros",
    ),
    Verb(
        "agent", "understudy.agent.process", "the sidecar of an instance", in_pods=True, has_options=False, extra="ros"
    ),
    Verb(
        "tasks",
        "understudy.action_proxy.process",
        "the action proxy of a workload",
        in_pods=True,
        has_options=False,
        extra="ros",
    ),
    Verb(
        "prepare",
        "understudy.agent.prepare",
        "the init container that writes the DDS profiles of an instance",
        in_pods=True,
        has_options=False,
    ),
)

_BY_NAME = {verb.name: verb for verb in VERBS}
_FOR_PEOPLE = [verb for verb in VERBS if verb.group]

_WITH_VALUE = ("-n", "--namespace", "--context", "--kubeconfig", "--as", "--request-timeout")
"""Options that may be in front of the verb, as in ``kubectl understudy -n fleet status``, and that have a value."""


_COLORS = ("auto", "always", "never")

_BROKEN_PIPE = 141
"""The exit status of a program that SIGPIPE ended, as a shell reports it."""


def main() -> int:
    """Run the verb that the first argument names. Imports only the module of that verb, which keeps pods small."""
    status = _BROKEN_PIPE
    with _quiet_broken_pipe():
        status = _main()
    return status


@contextlib.contextmanager
def _quiet_broken_pipe() -> Iterator[None]:
    """End without an error if the program that reads the output, such as ``head``, has exited."""
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        if not _is_unread(sys.stdout):
            raise
        # Otherwise, the interpreter would report what it cannot write when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_unread(out: TextIO) -> bool:
    """Return whether a stream is a pipe that nobody reads any more. Other pipes and sockets break, too."""
    import select  # not at the top, because pods do not need it

    poll = select.poll()
    poll.register(out.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _main() -> int:
    arguments = sys.argv[1:]
    if "_ARGCOMPLETE" in os.environ:
        return _complete()
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    try:
        arguments = _verb_first(_without_color(arguments))
    except ValueError as error:
        print(f"understudy: {error}", file=sys.stderr)
        return 2
    if arguments and arguments[0] in ("--version", "version"):
        print(f"understudy {__version__}")
        return 0
    if not arguments or arguments[0].startswith("-"):
        print(_help(), file=sys.stderr)
        return 2
    verb = _BY_NAME.get(arguments[0])
    if verb is None:
        print(f"understudy: unknown verb {arguments[0]!r}{_suggestion(arguments[0])}", file=sys.stderr)
        return 2
    if not verb.in_pods:
        with importlib.import_module("understudy.cli.common.text.terminal").guarded_output():
            return _run(verb, arguments[1:])
    _end(_run(verb, arguments[1:]))


def _without_color(arguments: list[str]) -> list[str]:
    """Take ``--color`` out of the arguments, into the environment. Raises ValueError."""
    place = next((place for place, word in enumerate(arguments) if word.partition("=")[0] == "--color"), None)
    if place is None:
        return arguments
    _, equals, value = arguments[place].partition("=")
    last = place if equals else place + 1
    value = value if equals else "".join(arguments[last : last + 1])
    if value not in _COLORS:
        raise ValueError(f"--color: found {value!r}; give one of {', '.join(_COLORS)}")
    os.environ[importlib.import_module("understudy.cli.common.text.terminal").COLOR] = value
    return arguments[:place] + arguments[last + 1 :]


def _verb_first(arguments: list[str]) -> list[str]:
    """Move options in front of the verb behind it, if there is a verb. The verb refuses what it does not have."""
    count = 0
    while count < len(arguments) and arguments[count].startswith("-"):
        count += 2 if arguments[count] in _WITH_VALUE else 1
    return [*arguments[count : count + 1], *arguments[:count], *arguments[count + 1 :]]


def _run(verb: Verb, arguments: list[str]) -> int:
    try:
        status: int = import_frozen(verb.module).main(arguments)
    except ModuleNotFoundError as error:
        if not verb.extra or (error.name or __package__).partition(".")[0] == __package__:
            traceback.print_exc()
        else:
            hint = f"install understudy with the extra {verb.extra}: pip install '.[{verb.extra}]' in its repository"
            print(
                f"understudy {verb.name} needs the Python package {error.name}, which is not installed; {hint}",
                file=sys.stderr,
            )
        return 1
    except Exception as error:
        if isinstance(error, BrokenPipeError) and not verb.in_pods:
            raise
        traceback.print_exc()
        return 1
    return status


def _end(status: int) -> NoReturn:
    """End the process at once, with all that was logged and printed.

    Otherwise the interpreter waits for every thread, and then libraries free what the threads of the middleware may still use. A
    monitor that wanted to start again hung there for minutes, and nobody watched its robot.
    """
    try:
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def import_frozen(module: str) -> ModuleType:
    """Import a module without garbage collection, and exempt what it loads from later collections.

    Scanning objects that stay for the life of the process took a tenth of the start of a monitor.
    """
    gc.disable()
    try:
        return importlib.import_module(module)
    finally:
        gc.freeze()
        gc.enable()


def _help() -> str:
    width = max(len(verb.name) for verb in _FOR_PEOPLE) + 2
    lines = ["usage: understudy VERB ..."]
    for group in (SEE, ACT, DESIGN, SET_UP):
        lines += ["", group]
        lines += [f"  {verb.name:{width}}{verb.summary}" for verb in _FOR_PEOPLE if verb.group == group]
    lines += ["", "Use understudy VERB --help for the options of a verb, and understudy version for the version."]
    lines += ["Every verb also has --color auto|always|never. Options may be in front of the verb, as for kubectl."]
    return "\n".join(lines)


def _suggestion(found: str) -> str:
    import difflib  # not at the top, because pods do not need it

    close = difflib.get_close_matches(found, [verb.name for verb in _FOR_PEOPLE], n=1)
    return f"; did you mean {close[0]!r}?" if close else "; understudy --help lists all verbs"


def _complete() -> int:
    """Answer the completion request of a shell."""
    shell_completion = importlib.import_module("understudy.cli.common.shell_completion")
    verbs = [*(verb.name for verb in _FOR_PEOPLE), "version"]
    verb = _BY_NAME.get(shell_completion.complete_verb(verbs, _WITH_VALUE))
    if verb is not None and not verb.in_pods:
        shell_completion.complete_arguments(importlib.import_module(verb.module).main)
    return 1


if __name__ == "__main__":
    sys.exit(main())
