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
``understudy.trying``.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
from types import ModuleType

from understudy import __version__

PARTS = {
    "operator": "understudy.controller.running",
    "monitor": "understudy.monitor.running",
    "agent": "understudy.agent.running",
    "tasks": "understudy.tasks.running",
    "prepare": "understudy.agent.preparing",
    "verify": "understudy.controller.verifying",
    "simulate": "understudy.trying.simulating",
    "watch": "understudy.trying.watching",
    "learn": "understudy.trying.learning",
    "check": "understudy.checking.running",
    "tree": "understudy.console.tree",
    "status": "understudy.console.status",
    "timeline": "understudy.console.timeline",
    "explain": "understudy.console.explain",
    "pause": "understudy.console.pause",
    "resume": "understudy.console.resume",
    "failover": "understudy.console.failover",
    "failback": "understudy.console.failback",
    "fence": "understudy.console.fence",
    "inject": "understudy.console.inject",
    "robot-profile": "understudy.console.robotprofile",
    "doctor": "understudy.console.doctor",
    "completion": "understudy.console.completion",
    "blackbox": "understudy.console.blackbox",
    "tracker": "understudy.tracker.running",
    "size": "understudy.planning.size",
    "recommend": "understudy.planning.recommend",
    "report": "understudy.reporting.report",
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
    completing = importlib.import_module("understudy.console.completing")
    typed = [part for part in PARTS if part not in _IN_PODS]
    found = completing.verb(typed)
    if found in typed:
        completing.answer_by(importlib.import_module(PARTS[found]).main)
    return 1


if __name__ == "__main__":
    sys.exit(main())
