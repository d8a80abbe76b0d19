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

import importlib
import os
import sys

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


def main() -> int:
    """Run the part named by the first argument; imports only that one, since each must stay small."""
    arguments = sys.argv[1:]
    if "_ARGCOMPLETE" in os.environ:
        return _complete()
    if not arguments or arguments[0] not in PARTS:
        print(f"usage: understudy {{{'|'.join(PARTS)}}}", file=sys.stderr)
        return 2
    result: int = importlib.import_module(PARTS[arguments[0]]).main(arguments[1:])
    return result


def _complete() -> int:
    """Answer a shell that asks how the line may go on. Verbs that work on files leave it to the shell."""
    completing = importlib.import_module("understudy.console.completing")
    found = PARTS.get(completing.verb([part for part in PARTS if part not in _IN_PODS]) or "", "")
    if found.startswith("understudy.console."):
        importlib.import_module(found).main([])
    return 1


if __name__ == "__main__":
    sys.exit(main())
