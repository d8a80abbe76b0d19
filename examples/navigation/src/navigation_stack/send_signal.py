"""Sends a signal to nodes of the stack, to see what their failure does: ``python -m navigation_stack.send_signal STOP amcl``.

Without names it goes to all nodes and to the process that started them. Images have no pkill.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from navigation_stack.names import NODES


def processes(module: str) -> Iterator[int]:
    """Ids of the processes in this process's namespace that run a module, ``python -m MODULE``.

    A node's own processes see those of its pods too, which are none of their business.
    """
    ours = os.readlink("/proc/self/ns/pid")
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if os.readlink(folder / "ns" / "pid") != ours:
                continue
            words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:  # it has ended meanwhile
            continue
        if any(pair == ("-m", module) for pair in itertools.pairwise(words)):
            yield int(folder.name)


def main() -> int:
    """Send it; 1 where a node that was named does not run."""
    parser = argparse.ArgumentParser(prog="send_signal", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("signal", help="its name, such as KILL, STOP or CONT")
    parser.add_argument("node", nargs="*", metavar="NODE", help="which nodes")
    options = parser.parse_args()
    if unknown := sorted(set(options.node) - set(NODES)):
        parser.error(f"node: found {', '.join(unknown)}, which is none of {', '.join(NODES)}")
    if f"SIG{options.signal.removeprefix('SIG')}" not in signal.Signals.__members__:
        parser.error(f"signal: found {options.signal}, give a name such as KILL, STOP or CONT")
    number = signal.Signals[f"SIG{options.signal.removeprefix('SIG')}"]
    modules = [f"navigation_stack.{node}" for node in options.node or NODES]
    if not options.node:
        modules.insert(0, "navigation_stack")
    found = {module: list(processes(module)) for module in modules}
    for module, ids in found.items():
        for one in ids:
            with contextlib.suppress(ProcessLookupError):  # with who started them, they end by themselves
                os.kill(one, number)
            print(f"{number.name} to {module} ({one})")
    missing = [module for module, ids in found.items() if not ids]
    if missing:
        print(f"not running: {', '.join(missing)}", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
