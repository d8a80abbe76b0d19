"""What a monitor at this address says of the readers of /chat, as it changes: ``python reading.py JSON``. Says ``ready`` first.

JSON has the ``address``, the ``instances`` (IP by name), and ``robots``, the addresses of those outside the cluster.
"""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import dataclass
from typing import Any, cast

from tests.unit.monitor.cluster_objects import ClusterObjects
from understudy.monitor.notices import Notices
from understudy.monitor.observe.robot import robot_readers
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.ros.runtime.graph_node import Graph


class Printed(Notices):
    """Prints each change of a condition."""

    def condition(self, type_: str, *fields: str) -> bool:
        line = json.dumps([type_, *fields])
        if line != getattr(self, "last", ""):
            self.last = line
            print(line, flush=True)
        return True


@dataclass
class Observer:
    """What the monitor's observer knows of the graph."""

    graph: Graph
    addresses: dict[str, str]


def main(arguments: dict[str, Any]) -> None:
    robot_readers.PERIOD, robot_readers.SETTLE = 0.2, 1.0
    watched = ClusterObjects(workload="robot-17")
    outputs = [{"topic": "/chat", "type": "std_msgs/msg/String"}]
    watched.put_workload(outputs=outputs, gate={"robots": arguments["robots"]})
    graph = Graph("understudy_monitor")
    own = graph.subscribe("/chat", "std_msgs/msg/String", depth=1)
    observer = cast(HealthObserver, Observer(graph, arguments["instances"]))
    notices = Printed()
    print("ready", flush=True)
    asyncio.run(RobotReaders(watched.view, observer, notices, arguments["address"]).run())
    del own


main(json.loads(sys.argv[1]))
