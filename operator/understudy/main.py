"""One command: for the parts that run in pods, ``understudy operator | monitor | agent | tasks | prepare``, and for people.

``understudy check`` validates manifests without a cluster, ``understudy status`` shows the robots of one, ``understudy
timeline`` their recoveries, ``understudy explain`` why one is as it is, ``understudy tree`` a workload's live health tree,
``understudy pause`` has one left alone and ``understudy resume`` no longer,
``understudy failover`` and ``understudy failback`` have a robot driven by another instance as planned,
``understudy blackbox`` fetches what was recorded of a failure,
``understudy tracker`` watches robots by a camera, ``understudy size`` says how many fallbacks a fleet needs, ``understudy
recommend`` which strategies. What tries a policy without a cluster is in ``understudy.trying``.
"""

from __future__ import annotations

import importlib
import sys

_PARTS = {
    "operator": "understudy.controller.running",
    "monitor": "understudy.monitor.running",
    "agent": "understudy.agent.running",
    "tasks": "understudy.tasks.running",
    "prepare": "understudy.agent.preparing",
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
    "blackbox": "understudy.console.blackbox",
    "tracker": "understudy.tracker.running",
    "size": "understudy.planning.size",
    "recommend": "understudy.planning.recommend",
}


def main() -> int:
    """Run the part named by the first argument; imports only that one, since each must stay small."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] not in _PARTS:
        print(f"usage: understudy {{{'|'.join(_PARTS)}}}", file=sys.stderr)
        return 2
    result: int = importlib.import_module(_PARTS[arguments[0]]).main(arguments[1:])
    return result


if __name__ == "__main__":
    sys.exit(main())
