"""The robot of examples/forklift: a truck that takes velocities and fork heights, and whose beacon is switched by a service.

It writes down what it receives. It knows nothing of Understudy, of a gate or of a mux.
"""

from __future__ import annotations

import os
import time

from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from understudy_quickstart.journal import Journal
from understudy_quickstart.running import run


class Truck(Node):
    """Accepts everything, and moves nothing."""

    def __init__(self, journal: Journal) -> None:
        super().__init__("truck")
        self._journal = journal
        self.create_subscription(TwistStamped, "/forklift/velocity", self._driven, 10)
        self.create_subscription(Float64, "/forklift/fork_height", self._lifted, 10)
        self.create_service(SetBool, "/forklift/beacon", self._switched)

    def _driven(self, message: TwistStamped) -> None:
        self._journal.write("velocity", received=time.time(), source=message.header.frame_id)

    def _lifted(self, message: Float64) -> None:
        self._journal.write("fork_height", received=time.time(), height=message.data)

    def _switched(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._journal.write("beacon", received=time.time(), on=request.data)
        response.success = True
        return response


def main() -> None:
    """Run the truck until it is asked to stop. ``ROBOT_LOG`` names the journal's file."""
    journal = Journal(os.environ.get("ROBOT_LOG"))
    run(lambda: Truck(journal))


if __name__ == "__main__":
    main()
