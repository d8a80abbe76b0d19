"""Types work without the code generator, which stays out of memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

PACKAGE = Path(__file__).parents[3] / "operator"


def run(code: str) -> dict:
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE), "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return json.loads(found.stdout)


SAY = """
import json, sys
print(json.dumps({
    "works": len(serialize_message(Twist())),
    "loaded": sorted({"em", "lark", "rosidl_generator_py"} & set(sys.modules)),
}))
"""


def test_messages_work_without_the_code_generator():
    found = run(
        "import understudy.ros.runtime.graph_node\n"
        "from understudy.ros.runtime.interface_types import message_class\n"
        "from rclpy.serialization import serialize_message\n"
        "Twist = message_class('geometry_msgs/msg/Twist')\n" + SAY
    )
    assert found == {"works": 52, "loaded": ["rosidl_generator_py"]}


def test_a_loaded_code_generator_is_not_changed():
    found = run(
        "import rosidl_generator_py\n"
        "from understudy.ros.runtime.lean_imports import leave_out_generator\n"
        "assert not leave_out_generator()\n"
        "assert rosidl_generator_py.generate_py\n"
        "from geometry_msgs.msg import Twist\n"
        "from rclpy.serialization import serialize_message\n" + SAY
    )
    assert "lark" in found["loaded"]


def test_two_threads_can_import_rclpy_at_the_same_time():
    found = run(
        "import asyncio, json, threading\n"
        "from understudy.ros.runtime.lean_imports import import_rclpy, rclpy_imported\n"
        "failed = []\n"
        "def use():\n"
        "    try:\n"
        "        import_rclpy()\n"
        "        from rclpy.node import Node\n"
        "    except BaseException as error:\n"
        "        failed.append(repr(error))\n"
        "async def run():\n"
        "    threads = [threading.Thread(target=use) for _ in range(4)]\n"
        "    for thread in threads: thread.start()\n"
        "    await asyncio.gather(rclpy_imported(), rclpy_imported())\n"
        "    from rclpy.serialization import serialize_message\n"
        "    for thread in threads: thread.join()\n"
        "asyncio.run(run())\n"
        "print(json.dumps(failed))\n"
    )
    assert found == []
