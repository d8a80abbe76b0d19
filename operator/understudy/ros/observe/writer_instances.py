"""Follows which instance each writer of some topics or services belongs to, by its DDS partition.

The partition has the name of the pod, so this also tells instances apart that have one address, as pods in the network of their node. DDS
discovery is asked only for writers that are new.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Collection, Hashable

from understudy.ros.rmw import MIDDLEWARE

_logger = logging.getLogger(__name__)

COUNT_PERIOD, LIST_PERIOD = 0.2, 2.0
"""Seconds between two looks whether the number of writers has changed, and between two lists of them."""

DISCOVERED_WITHIN = 1.0
"""Seconds that discovery has to report the partition of a writer, before it is asked again."""


class WriterInstances:
    """The writers of one graph."""

    def __init__(self, address: str = "") -> None:
        """``address`` is this host's own, to which discovery answers; empty for the one from which this host sends to others."""
        self._address = address
        self.names: dict[bytes, str] = {}
        """The name of the pod, by the GID of a writer; empty for a writer of no instance."""

    async def follow(
        self,
        counts: Callable[[], Hashable],
        look: Callable[[], Collection[bytes]],
        learned: Callable[[], None],
    ) -> None:
        """Follow the writers until cancelled.

        Args:
            counts: Returns the numbers of writers and of whatever else ``look`` depends on: far cheaper than a list.
            look: Returns the GIDs of the writers that are present. It is called again as soon as one of them was learned.
            learned: Called when discovery has reported new writers.
        """
        known: Hashable = None
        again = 0.0
        while True:
            now, counted = time.monotonic(), counts()
            if counted != known or now >= again:
                known, again = counted, now + LIST_PERIOD
                present = look()
                if has_learned := await self.update(present):
                    learned()
                if has_learned or set(present) - self.names.keys():
                    again = 0.0
            await asyncio.sleep(COUNT_PERIOD)

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
