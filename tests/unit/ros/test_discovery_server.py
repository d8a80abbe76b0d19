"""A discovery server that takes the place of another, as the image starts it, with real participants."""

from __future__ import annotations

import json
import time

import pytest

from tests.unit.ros.conftest import kill

pytest.importorskip("rclpy")

pytestmark = pytest.mark.ros


def test_a_new_discovery_server_knows_the_participants_of_its_predecessor(discovery_server, processes) -> None:
    def hear() -> None:
        reader = processes.node("obey", "/chat", json.dumps({"publisher": "127.0.0.1"}))
        assert processes.line(reader, 60), "a sample's sender"

    server = discovery_server()
    processes.node("publish", "/chat", "10")
    hear()
    time.sleep(4.0)  # until all that they have to tell the server has been taken by it
    kill(server)
    discovery_server()
    hear()
