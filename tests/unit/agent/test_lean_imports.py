"""An agent has no models of the API in memory, of which there is one in every pod, and has what a recovery needs before it comes."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from pydantic import ValidationError

from tests.unit.agent.conftest import PACKAGE, Pod, eventually
from understudy.agent.instance_health import HealthPlan
from understudy.agent.output_topics import Output
from understudy.agent.process import _PROCEDURES, _WARM
from understudy.api.kinds import robot_workload

HEAVY = {"aiohttp", "antlr4", "kopf", "kubernetes", "prometheus_client", "pydantic", "scenario_execution"}

CONFIGURED = """
from understudy.agent.instance_health import HealthPlan
HealthPlan.of({"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": [{"topic": "/x", "type": "std_msgs/msg/Empty"}], "grace": 1})
HealthPlan.of({"form": "xml", "tree": '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/x" gap="1s"/></BehaviorTree></root>'})
"""


def _modules(code: str) -> set[str]:
    """What is loaded once this was run."""
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE), "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    shown = f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", shown], env=environment, capture_output=True, text=True, check=True)
    return set(json.loads(found.stdout))


def test_a_starting_agent_has_imported_neither_ros_nor_trees() -> None:
    found = _modules("import understudy.agent.process")
    assert not found & {*HEAVY, "numpy", "py_trees", "rclpy", "yaml"}


@pytest.mark.ros
def test_a_ready_agent_has_not_imported_the_api_models() -> None:
    assert not _modules(f"import understudy.agent.process, {', '.join(_WARM)}\n{CONFIGURED}") & HEAVY


@pytest.mark.ros
def test_a_held_agent_imports_nothing_more_when_it_is_claimed() -> None:
    imports = f"import understudy.agent.process, {', '.join(_WARM)}"
    more = _modules(f"{imports}\n{CONFIGURED}") - _modules(imports)
    assert not {name for name in more if name.startswith("understudy.")}


async def test_procedures_are_imported_before_the_first_request(pod: Pod) -> None:
    pod.environment = {"UNDERSTUDY_HELD_CONTAINERS": "", "UNDERSTUDY_WORKLOAD": "robot", "PYTHONVERBOSE": "1"}
    pod.start_agent()
    await eventually(lambda: f"import '{_PROCEDURES}'" in (pod.folder / "agent.log").read_text(errors="replace"))


GOOD = [
    {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},
    {"service": "/robot/snap", "type": "std_srvs/srv/Trigger", "of a newer monitor": 1},
    {"action": "/go_to", "type": "nav2_msgs/action/NavigateToPose", "topic": None},
]
BAD = [
    {},
    {"topic": "/x"},
    {"topic": "x", "type": "std_msgs/msg/Empty"},
    {"topic": "/x\n", "type": "std_msgs/msg/Empty"},
    {"topic": 3, "type": "std_msgs/msg/Empty"},
    {"service": "/" + 256 * "x", "type": "std_srvs/srv/Trigger"},
    {"topic": "/x", "type": "std_msgs/Empty"},
    {"topic": "/x", "type": ["std_msgs/msg/Empty"]},
    "/x",
]


@pytest.mark.parametrize("data", GOOD)
def test_an_output_is_read_as_the_model_reads_it(data: dict[str, object]) -> None:
    ours, model = Output.from_wire(data), robot_workload.Output.model_validate(data)
    assert (ours.topic, ours.service, ours.action, ours.type, ours.name) == (
        model.topic,
        model.service,
        model.action,
        model.type,
        model.name,
    )


@pytest.mark.parametrize("data", BAD)
def test_an_output_that_the_model_refuses_is_refused(data: object) -> None:
    with pytest.raises(ValidationError):
        robot_workload.Output.model_validate(data)
    with pytest.raises(ValueError, match="output"):
        HealthPlan.of({"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": [data]})


AT_ONCE = """
import asyncio, sys, threading, time
from understudy.agent import process
from understudy.agent.instance_health import HealthPlan

finding, near = set(), threading.Event()

class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "understudy.trees.core.health_tree":
            near.set()
        if name == "py_trees.behaviour":
            near.wait(2)
        if name.startswith("py_trees"):
            finding.add(threading.current_thread())
            time.sleep(0.05)

sys.meta_path.insert(0, Slow())

async def main():
    warming = asyncio.create_task(process._imported("py_trees"))
    await asyncio.sleep(0.02)
    body = {"tree": {"topic": {"name": "/x", "gap": "1s"}}, "outputs": [{"topic": "/x", "type": "std_msgs/msg/Empty"}], "grace": 1}
    await asyncio.gather(warming, asyncio.to_thread(HealthPlan.of, body))

asyncio.run(main())
assert len(finding) == 1, finding
"""


def test_a_health_tree_is_read_after_another_thread_has_imported_what_it_needs() -> None:
    """At the end of an import, a package is not in sys.modules for a moment: another thread that imports a part of it fails."""
    assert "py_trees.decorators" in _modules(AT_ONCE)
