"""One command: for the parts that run in pods, ``understudy operator | monitor | agent | tasks | prepare``, and for people.

``understudy check`` validates manifests without a cluster.
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
    "check": "understudy.checking.running",
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
