"""Follows which instance each writer of some topics or services belongs to, by its DDS partition.

The partition has the name of the pod, so this also tells instances apart that have one address, as pods in the network of their node. DDS
discovery is asked only for writers that are new.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Collection

from understudy.ros.rmw import MIDDLEWARE

_logger = logging.getLogger(__name__)

DISCOVERED_WITHIN = 1.0
"""Seconds that discovery has to report the partition of a writer, before it is asked again."""


class WriterInstances:
    """The writers of one graph."""

    def __init__(self, address: str = "") -> None:
        """``address`` is this host's own, to which discovery answers; empty for the one from which this host sends to others."""
        self._address = address
        self.names: dict[bytes, str] = {}
        """The name of the pod, by the GID of a writer; empty for a writer of no instance."""

    async def update(self, present: Collection[bytes]) -> bool:
        """Forget the writers that are gone, and ask for those that are new. Returns whether discovery has reported any."""
        for gone in self.names.keys() - present:
            del self.names[gone]
        if unknown := set(present) - self.names.keys():
            try:
                self._address = self._address or _own_address()
                found = await MIDDLEWARE.instances_of_writers(
                    unknown, self._address, os.environ, within=DISCOVERED_WITHIN
                )
            except (OSError, ValueError) as error:
                _logger.warning("discovery cannot be asked whose writers there are: %s", error)
            else:
                self.names.update(found)  # others hold this mapping
                return bool(found)
        return False


def _own_address() -> str:
    """Return the address from which this host sends to others. Raises OSError."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probing:
        probing.connect(("239.255.0.1", 7400))
        return str(probing.getsockname()[0])
