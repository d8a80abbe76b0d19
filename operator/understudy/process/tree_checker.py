"""Checks trees in a process of their own, so that no text can keep the event loop busy, however long its check takes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import struct
import sys
from dataclasses import asdict

from understudy.trees.languages.tree_check import INVALID, TreeText, Verdict, too_costly

_logger = logging.getLogger(__name__)

LENGTH = struct.Struct("=I")
"""The length of a request or an answer, which stands before it."""

MOST_SECONDS = 3.0
"""Processor time that the check of one tree may take: ten times that of the most costly tree that has a use (510 leaves in
OpenSCENARIO 2 take 0.3 s)."""

MOST_BYTES = 2**28
"""Memory that the process may allocate."""

_PROGRAM = "understudy.process.tree_checker_program"


class TreeChecker:
    """A process that checks one tree at a time. It is started for the first tree, and again after its end."""

    def __init__(self) -> None:
        self._process: asyncio.subprocess.Process | None = None

    @property
    def running(self) -> bool:
        """Whether the process exists."""
        return self._process is not None

    async def check(self, tree: TreeText) -> Verdict:
        """Check a tree. A tree that ends the process twice is refused.

        Raises OSError if the process cannot be started.
        """
        code = 0
        for _ in range(2):
            process = await self._started()
            try:
                return await _asked(process, tree)
            except (asyncio.IncompleteReadError, ConnectionError):
                self._process, code = None, await process.wait()
                _logger.warning("the process that checked %s ended with status %d", tree.path, code)
                if code == -signal.SIGXCPU:
                    why = f"its check takes more than {MOST_SECONDS:g} s of processor time"
                    return too_costly(tree, why, MOST_SECONDS)
            except asyncio.CancelledError:
                await self.close(kill=True)
                raise
        return Verdict(INVALID, f"{tree.path}: the process that checks it ended with status {code}", cost=MOST_SECONDS)

    async def close(self, *, kill: bool = False) -> None:
        """End the process: after the check in progress, or at once with ``kill``."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        process.stdin.close()
        if kill:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        await process.wait()

    async def _started(self) -> asyncio.subprocess.Process:
        if self._process is None:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                _PROGRAM,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                start_new_session=True,  # the terminal's signals are for the process that asks
            )
        return self._process


async def _asked(process: asyncio.subprocess.Process, tree: TreeText) -> Verdict:
    assert process.stdin is not None
    assert process.stdout is not None
    request = json.dumps(asdict(tree)).encode()
    process.stdin.write(LENGTH.pack(len(request)) + request)
    await process.stdin.drain()
    (length,) = LENGTH.unpack(await process.stdout.readexactly(LENGTH.size))
    return Verdict(**json.loads(await process.stdout.readexactly(length)))
