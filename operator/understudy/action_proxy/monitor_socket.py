"""The socket on which the monitor reports the state of control, and the proxy reports the state of its tasks.

It is a Unix socket in a folder that only the two containers share. Each line is one JSON object: ``{"situation": ...}``
to the proxy, and ``{"report": ...}`` back on every change.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from understudy.action_proxy.control_state import ControlState

_logger = logging.getLogger(__name__)

MOST = 1 << 20
"""Largest size of a line, in bytes."""


class MonitorSocket:
    """The proxy's end."""

    def __init__(self, on_situation: Callable[[ControlState], None], report: Callable[[], Mapping[str, Any]]) -> None:
        self._on_situation, self._report = on_situation, report
        self._writers: set[asyncio.StreamWriter] = set()

    def hand_over(self, on_situation: Callable[[ControlState], None], report: Callable[[], Mapping[str, Any]]) -> None:
        """Pass the states of control to another receiver, which also gives the report from now on."""
        self._on_situation, self._report = on_situation, report

    async def listen(self, path: Path) -> asyncio.Server:
        """Listen at a path. Raises OSError, also if the file exists already."""
        return await asyncio.start_unix_server(self._connected, path, limit=MOST)

    def send_state(self) -> None:
        """Report the state of the tasks."""
        line = json.dumps({"report": self._report()}).encode() + b"\n"
        for writer in self._writers:
            with contextlib.suppress(OSError, RuntimeError):
                writer.write(line)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            self.send_state()
            while line := await reader.readline():
                self._on_situation(ControlState.from_wire(json.loads(line)["situation"]))
        except (ValueError, KeyError, TypeError) as error:
            _logger.error("cannot understand the monitor's message: %r", error)
        except OSError as error:
            _logger.debug("the monitor is gone: %r", error)
        finally:
            self._writers.discard(writer)
            writer.close()
