"""A campaign of random faults against robots on the real cluster, judged at the robots.

    scripts/bench chaos [--faults 100] [--seed 1] [--robots WAY ...] [--every 4] [--only KIND ...] [--timeout 1]

Six robots are driven at once, each recovered in another way: an executing standby, the same with a reflex, a
restart, a held pod with an application in C, a configured standby, and an application that counts its steps and
serves goals. Every few seconds something fails: processes, pods, nodes, links, networks, monitors, the operator, the
API server, discovery servers, gates, muxes and labels. The seed decides what, when and to whom. Each robot's own log says
which commands it received, who sent them, and when. It is compared with the gate's commits, the recorded recoveries and the faults.

The bench needs the local provider, because no other provider can do all that. The clock of a node cannot be changed
there, since all nodes have this machine's clock.
"""

from __future__ import annotations

import argparse
import os
import sys
import uuid
from pathlib import Path

from bench.chaos import plan, ways


def main() -> int:
    parser = argparse.ArgumentParser(
        "scripts/bench chaos", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--faults", type=int, default=100, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--robots", nargs="+", choices=list(ways.BY_NAME), default=list(ways.BY_NAME), metavar="WAY",
                        help=f"one robot for each of {', '.join(ways.BY_NAME)} (default: all); six use two cores up")  # fmt: skip
    parser.add_argument("--every", type=float, default=4.0, metavar="SECONDS", help="mean time between two faults")
    parser.add_argument("--only", nargs="+", choices=list(plan.BY_NAME), default=[], metavar="KIND",
                        help=f"kinds of faults: {', '.join(plan.BY_NAME)} (default: all)")  # fmt: skip
    parser.add_argument("--timeout", type=float, default=1.0, metavar="SECONDS",
                        help="time without commands that the policies treat as a failure")  # fmt: skip
    parser.add_argument("--mux", choices=["none", "half", "all"], default="half",
                        help="how many of the robots have the gate kind Mux: every second one by default")  # fmt: skip
    parser.add_argument("--machine", default="", metavar="TEXT", help="what else the machine does, for the results")
    options = parser.parse_args()

    from bench.chaos.campaign import run  # here, so that --help needs nothing of the cluster

    kubeconfig = Path(os.environ["KUBECONFIG"])
    return run(kubeconfig, f"chaos-{uuid.uuid4().hex[:6]}", options)


if __name__ == "__main__":
    sys.exit(main())
