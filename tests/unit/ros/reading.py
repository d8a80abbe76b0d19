"""What a monitor at this address says of the readers of /chat, as it changes: ``python reading.py JSON``. Says ``ready`` first.

JSON has the ``address``, the ``instances`` (IP by name), and ``robots``, the addresses of those outside the cluster.
"""

from __future__ import annotations

import asyncio
import json
import sys
from types import SimpleNamespace
from typing import Any

from understudy.api.kinds.robot_workload import Output
from understudy.monitor.notices import Notices
from understudy.monitor.observe.robot import robot_readers
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.ros.runtime.graph_node import Graph


class Printed(Notices):
    """Prints each change of a condition."""

    def condition(self, type_: str, *said: str) -> bool:
        line = json.dumps([type_, *said])
        if line != getattr(self, "last", ""):
            self.last = line
            print(line, flush=True)
        return True


def main(given: dict[str, Any]) -> None:
    robot_readers.PERIOD, robot_readers.SETTLE = 0.2, 1.0
    outputs = [Output(topic="/chat", type="std_msgs/msg/String")]
    spec = SimpleNamespace(outputs=outputs, gate=SimpleNamespace(robots=given["robots"]))
    view: Any = SimpleNamespace(spec=spec, retired=False, workload="robot-17")
    graph = Graph("understudy_monitor")
    own = graph.subscribe("/chat", "std_msgs/msg/String", depth=1)
    sight: Any = SimpleNamespace(graph=graph, addresses=given["instances"])
    told = Printed()
    print("ready", flush=True)
    asyncio.run(RobotReaders(view, sight, told, given["address"]).run())
    del own


main(json.loads(sys.argv[1]))
