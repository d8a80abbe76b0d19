"""The active instance fails while the API server is away: the standby drives as soon as the API server is back."""

from __future__ import annotations

import signal
import time

import pytest

from tests.e2e.faults import ApiServer, cluster, has_network_modes, signal_processes, staying
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import APPLICATION, Late, Robot, manifest
from tests.e2e.test_strategies import assert_handed_over
from understudy.failover.strategies.steps import LATE_AT_MOST

BACK_WITHIN = 0.5
"""Seconds from the return of the API server to the standby's first command at the robot, if the network follows the gate at once."""


@pytest.mark.long
@pytest.mark.local_only
@pytest.mark.parametrize("outage", [4, 8, 60])
def test_an_executing_standby_drives_once_the_api_server_is_back(
    kubectl: Kubectl, api_server: ApiServer, outage: float, gate_kind: str
) -> None:
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(manifest("strategies/executing.yaml"))
    kubectl.apply(staying(robot.objects(policy="quickstart-executing")))
    old = robot.wait_protected()
    uid = kubectl.get("pod", old)["metadata"]["uid"]
    api_server.stop()
    assert signal_processes(uid, APPLICATION, signal.SIGSTOP)
    time.sleep(outage)
    cluster("api", "start")
    back = time.time()
    api_server.start()
    # An engine such as Cilium asks the API server again after pauses that double.
    is_late = gate_kind == "NetworkPolicy" and not has_network_modes()
    within = LATE_AT_MOST if is_late else BACK_WITHIN
    recovery = robot.wait_recovered(1, within=90 + within)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", old), (
        "an outage of the API server fails no standby"
    )
    assert_handed_over(robot, recovery)
    first = min(command.received for command in robot.log().of(recovery.new) if command.received > back - outage)
    print(f"the standby's first command arrived {first - back:+.3f} s after the API server was ready")
    if first - back > within:
        raise Late(f"the standby drove {first - back:.3f} s after the return of the API server")
