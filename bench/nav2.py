"""The paper's first experiment with Nav2 itself: `scripts/bench navigation` with another stack.

    scripts/bench nav2 [--failures 20] [--how frozen|killed|deleted-by-force] [--configurations restart executing ...]

It needs a cluster (KUBECONFIG) whose nodes have the image of Nav2 (examples/navigation/README.md).
"""

from __future__ import annotations

import sys

from bench import tours
from bench.navigation import Navigation
from tests.e2e.nav2 import Nav2


class Nav2Navigation(Navigation):
    name = "nav2"
    robot = Nav2


if __name__ == "__main__":
    sys.exit(tours.run(Nav2Navigation(), tours.options(Nav2Navigation(), __doc__)))
