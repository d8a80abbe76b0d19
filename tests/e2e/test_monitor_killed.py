"""A monitor that is killed at any step of a recovery: the next one completes it or safely does it again."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Failed
from tests.e2e.scenario import Robot, eventually
from tests.e2e.test_strategies import assert_handed_over

CRASH_FILE = "/var/lib/understudy/crash-after"
MOST_STEPS = 20


def killed_at_every_step(robot: Robot, strategy: str) -> None:
    """Fail the workload again and again, the monitor dying one step later each time, until it outlives the recovery."""
    monitor = f"deployment/{robot.workload}-monitor"
    for step in range(MOST_STEPS):
        number = step + 1
        robot.replace_monitor()  # a pod whose container hasn't been restarted yet is restarted without back-off
        old = robot.wait_protected()
        if strategy == "Fallback/Executing":
            robot.wait_standby()  # the status may be of the monitor before
        robot.kubectl("exec", monitor, "--", "sh", "-c", f"echo {step} >{CRASH_FILE}")
        robot.fail(old, "frozen")  # a killed one would be back by itself before the next monitor is
        recovery = robot.wait_recovered(number, within=120)
        died = robot.monitor_restarts() > 0
        print(f"step {step}: {'killed' if died else 'outlived it'}; {recovery.strategy} in {recovery.seconds:.2f} s")
        tried = [(a["strategy"], a["result"], a.get("message")) for a in robot.status()["recoveries"][0]["attempts"]]
        assert recovery.strategy == strategy, f"step {step}: {tried}, {recovery}"
        assert robot.status()["active"] == recovery.new
        assert len([r for r in robot.recoveries() if r.number == number]) == 1, "told once"
        assert_handed_over(robot, recovery)
        eventually(lambda old=old: not robot.has_pod(old), within=60, what=f"step {step}: the failed pod {old} is gone")
        if not died:
            robot.kubectl("exec", monitor, "--", "rm", "-f", CRASH_FILE)
            assert step >= 4, "there are at least: save, before commit, after commit, retire, record"
            return
    pytest.fail(f"more than {MOST_STEPS} steps")


@pytest.mark.long
@pytest.mark.own_robot  # after a recovery, the monitor that follows a killed one may take a failure for a relapse
def test_an_executing_fallback_survives_the_monitors_death_at_every_step(executing: Robot) -> None:
    killed_at_every_step(executing, "Fallback/Executing")


@pytest.mark.long
@pytest.mark.own_robot  # after a recovery, the monitor that follows a killed one may take a failure for a relapse
def test_an_uninitialized_fallback_survives_the_monitors_death_at_every_step(uninitialized: Robot) -> None:
    killed_at_every_step(uninitialized, "Fallback/Uninitialized")


@pytest.mark.long
@pytest.mark.own_robot  # after a recovery, the monitor that follows a killed one may take a failure for a relapse
def test_a_restart_survives_the_monitors_death_at_every_step(restarting: Robot) -> None:
    killed_at_every_step(restarting, "Restart")


def test_a_failure_while_the_monitors_pod_is_being_replaced_is_noticed_by_the_next(executing: Robot) -> None:
    old = executing.wait_protected()
    selector = f"understudy.dev/monitored={executing.workload},understudy.dev/component=monitor"
    executing.kubectl("delete", "pod", "-l", selector, "--wait=false", "--grace-period=0", "--force")
    try:
        executing.fail(old, "frozen")
    except Failed:
        pytest.fail("the application was not there to be frozen")
    recovery = executing.wait_recovered(1)
    assert recovery.old == old
    assert_handed_over(executing, recovery)
