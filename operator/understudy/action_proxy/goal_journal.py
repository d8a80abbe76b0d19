"""Files with the state that the task proxy needs after a restart of its container, or in another pod that has the same volume."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from understudy.action_proxy.control_state import TaskRule
from understudy.action_proxy.goal_ledger import GoalLedger
from understudy.clock import CLOCK
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)

FETCHED_WITHIN = 5.0
"""Seconds that the volume of the copy has to answer at the start of a proxy."""


class GoalJournal:
    """One file in the pod, replaced atomically. It is not synced: it guards against a killed process, not against a lost node."""

    def __init__(self, path: Path, copy: LastingCopy | None = None) -> None:
        self._path, self._copy = path, copy
        self._last = ""

    async def fetch(self) -> None:
        """Take the copy of an earlier pod, if this pod has no journal of its own yet."""
        if self._copy is None or self._path.exists():
            return
        try:
            async with asyncio.timeout(FETCHED_WITHIN):
                text = await asyncio.to_thread(self._copy.read)
        except (OSError, ValueError, TimeoutError) as error:
            _logger.error("the goals of an earlier pod cannot be read, continuing without them: %r", error)
            return
        if text:
            replace_file(self._path, text, mode=0o600)

    def save(self, ledger: GoalLedger, rules: Sequence[TaskRule]) -> None:
        """Store the goals and the tasks, if they differ from what was stored last. Raises OSError."""
        text = json.dumps({"ledger": ledger.to_wire(), "rules": [asdict(rule) for rule in rules]})
        if text == self._last:
            return
        replace_file(self._path, text, mode=0o600)
        self._last = text
        if self._copy is not None:
            self._copy.offer(text)

    def load(self) -> tuple[GoalLedger, tuple[TaskRule, ...]]:
        """Return what was stored; blank if nothing was.

        A damaged file is moved aside, since the proxy cannot continue from it.
        """
        try:
            data = json.loads(self._path.read_text())
            return GoalLedger.from_wire(data["ledger"], CLOCK.now()), tuple(TaskRule(**rule) for rule in data["rules"])
        except FileNotFoundError:
            return GoalLedger(), ()
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            _logger.error("%s cannot be read, continuing without its goals: %r", self._path, error)
            if self._path.exists():
                self._path.replace(self._path.with_suffix(".damaged"))
            return GoalLedger(), ()


class LastingCopy:
    """The copy of a journal on a volume that may outlive the pod.

    A thread writes it, because such a volume may be slow, or hang together with its server. The newest text counts.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._newest = ""
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    def read(self) -> str:
        """Return the text; empty if there is none. Raises OSError."""
        with contextlib.suppress(FileNotFoundError):
            return self._path.read_text()
        return ""

    def offer(self, text: str) -> None:
        """Write a text soon. Returns at once."""
        self._newest = text
        self._wake.set()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="copy of the goals", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                # Two pods may share the volume for a while.
                replace_file(self._path, self._newest, mode=0o600, shared=True, synced=True)
            except OSError as error:
                _logger.error("could not copy the goals to %s, so they are lost with this pod: %s", self._path, error)
