"""One command: for the parts that run in pods, ``understudy operator | monitor | agent | tasks | prepare | verify``, and
for people.

``understudy check`` validates manifests without a cluster, ``understudy status`` shows the robots of one, ``understudy
timeline`` their recoveries, ``understudy explain`` why one is as it is, ``understudy tree`` a workload's live health tree,
``understudy pause`` has one left alone and ``understudy resume`` no longer,
``understudy failover`` and ``understudy failback`` have a robot driven by another instance as planned,
``understudy fence`` shuts everybody out of one, ``understudy inject`` makes one fail, ``understudy robot-profile`` gives out
what a robot outside the cluster needs, ``understudy doctor`` finds out whether a cluster does what is needed, ``understudy
report`` writes what a period's recoveries came to, ``understudy completion`` has a shell complete all that, ``understudy
tracker`` watches robots by a camera, ``understudy size`` says how many fallbacks a fleet needs, ``understudy recommend`` which
strategies, ``understudy blackbox`` fetches what was recorded of a failure. What tries a policy without a cluster is in
``understudy.cli.simulate``.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
from types import ModuleType

from understudy import __version__

PARTS = {
    "operator": "understudy.controller.runtime.process",
    "monitor": "understudy.monitor.process",
    "agent": "understudy.agent.process",
    "tasks": "understudy.action_proxy.process",
    "prepare": "understudy.agent.prepare",
    "verify": "understudy.controller.runtime.installation_test",
    "simulate": "understudy.cli.simulate.simulate",
    "watch": "understudy.cli.simulate.watch",
    "learn": "understudy.cli.simulate.learn",
    "check": "understudy.cli.check.command",
    "tree": "understudy.cli.inspect.tree",
    "status": "understudy.cli.inspect.status",
    "timeline": "understudy.cli.inspect.timeline",
    "explain": "understudy.cli.inspect.explain",
    "pause": "understudy.cli.control.pause",
    "resume": "understudy.cli.control.resume",
    "failover": "understudy.cli.control.failover",
    "failback": "understudy.cli.control.failback",
    "fence": "understudy.cli.control.fence",
    "inject": "understudy.cli.inject.command",
    "robot-profile": "understudy.cli.control.robot_profile",
    "doctor": "understudy.cli.doctor.command",
    "completion": "understudy.cli.completion.command",
    "blackbox": "understudy.cli.inspect.blackbox",
    "tracker": "understudy.tracker.process",
    "size": "understudy.cli.plan.size",
    "recommend": "understudy.cli.plan.recommend",
    "report": "understudy.cli.report.command",
}
"""The module of each verb, whose ``main`` is given the arguments behind it."""

_IN_PODS = ("operator", "monitor", "agent", "tasks", "prepare")
"""What nobody types."""

_SAYS = {
    "check": "validate manifests, without a cluster",
    "status": "all robots: who is in control, what is ready, what is wrong",
    "explain": "why a robot is as it is, and what would happen if it failed now",
    "timeline": "a robot's last recoveries",
    "tree": "a robot's live health tree",
    "doctor": "does the cluster do what is needed?",
    "report": "what a period's recoveries came to, as a page",
    "blackbox": "what was recorded around a robot's failures",
    "pause": "leave a robot alone",
    "resume": "end a pause",
    "failover": "have an understudy take over, as planned",
    "failback": "give the robot back to the workload's own pod",
    "fence": "shut everybody out of a robot",
    "inject": "make the instance in control fail, where that is allowed",
    "robot-profile": "what a robot outside the cluster needs",
    "simulate": "a policy over a recorded bag",
    "watch": "a policy beside a live ROS graph",
    "learn": "gaps and rates from a recorded bag",
    "size": "how many fallbacks a fleet needs",
    "recommend": "which strategies the requirements come to",
    "tracker": "watch robots by a camera",
    "verify": "does the installation work? (helm test)",
    "completion": "have a shell complete all this at Tab",
}
"""For people, in the order in which they need it."""


def main() -> int:
    """Run the part named by the first argument; imports only that one, since each must stay small."""
    arguments = sys.argv[1:]
    if "_ARGCOMPLETE" in os.environ:
        return _complete()
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(f"understudy {__version__}")
        return 0
    if arguments[0] not in PARTS:
        print(f"understudy: there is no verb {arguments[0]!r}{_meant(arguments[0])}", file=sys.stderr)
        return 2
    result: int = _imported(PARTS[arguments[0]]).main(arguments[1:])
    return result


def _imported(name: str) -> ModuleType:
    """The module of a part, with all that it imports.

    To look for garbage again and again among what is there to stay took a tenth of a monitor's start, so it is exempted at once.
    """
    gc.disable()
    try:
        return importlib.import_module(name)
    finally:
        gc.freeze()
        gc.enable()


def _help() -> str:
    width = max(map(len, _SAYS)) + 2
    listed = "\n".join(f"  {verb:{width}}{says}" for verb, says in _SAYS.items())
    return f"usage: understudy VERB ...\n\n{listed}\n\nunderstudy VERB --help says more of one, understudy --version which this is."


def _meant(found: str) -> str:
    import difflib  # here, since the parts that run in pods must stay small

    close = difflib.get_close_matches(found, _SAYS, n=1)
    return f"; did you mean {close[0]!r}?" if close else "; understudy --help lists them"


def _complete() -> int:
    """Answer a shell that asks how the line may go on."""
    completing = importlib.import_module("understudy.cli.completion.answers")
    typed = [part for part in PARTS if part not in _IN_PODS]
    found = completing.verb(typed)
    if found in typed:
        completing.answer_by(importlib.import_module(PARTS[found]).main)
    return 1


if __name__ == "__main__":
    sys.exit(main())
