"""The addresses of the API server, as pods reach it: those behind the Service ``kubernetes``, and its own."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Protocol

from understudy.kube.client import ENDPOINT_SLICES, ApiError, Object, Resource

_logger = logging.getLogger(__name__)

REREAD = 60.0
"""Seconds after which the addresses are read again."""


class Reader(Protocol):
    """The read that this needs of an API client."""

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        """Return an object, or None if it does not exist."""


class ApiServerAddresses:
    """Reads the addresses at most once in REREAD seconds, and keeps the last ones while they cannot be read."""

    def __init__(self, reader: Reader, environment: Mapping[str, str]) -> None:
        """``environment`` is that of a pod; it names the address of the Service."""
        host, port = environment.get("KUBERNETES_SERVICE_HOST"), environment.get("KUBERNETES_SERVICE_PORT", "")
        self._reader = reader
        self._service = ((host, int(port)),) if host and port.isdigit() else ()
        self._behind: tuple[tuple[str, int], ...] = ()
        self._due = 0.0

    async def read(self) -> tuple[tuple[str, int], ...]:
        """Return addresses and ports: network engines judge packets before or after the Service's address is replaced."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + REREAD
            try:
                found = await self._reader.find(ENDPOINT_SLICES, "default", "kubernetes")
                self._behind = _addresses(found or {})
            except (ApiError, OSError) as error:
                _logger.warning("cannot read the addresses of the API server: %s", error)
        return tuple(dict.fromkeys((*self._service, *self._behind)))


def _addresses(found: Object) -> tuple[tuple[str, int], ...]:
    ports = [port["port"] for port in found.get("ports") or [] if port.get("port")]
    hosts = sorted(host for endpoint in found.get("endpoints") or [] for host in endpoint.get("addresses") or [])
    return tuple((host, port) for host in hosts for port in ports)
