"""Real DDS on this machine, for tests of every part: a domain of its own, and the loopback only."""

from __future__ import annotations

import os

import pytest


def isolate_discovery(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the environment that all nodes of a test share."""
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")  # heeded where the range isn't LOCALHOST
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for name in ("ROS_DISCOVERY_SERVER", "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_STATIC_PEERS"):
        monkeypatch.delenv(name, raising=False)
