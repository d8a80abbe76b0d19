"""Nodes and a discovery server, as for the tests of ``ros``."""

from tests.unit.ros.conftest import dds, discovery_server, processes

__all__ = ["dds", "discovery_server", "processes"]
