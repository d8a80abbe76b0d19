"""A file with the state that the task proxy needs after a restart of its container, or in another pod that has the same volume."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from understudy.action_proxy.control_state import TaskRule
from understudy.action_proxy.goal_ledger import GoalLedger
from understudy.clock import CLOCK

_logger = logging.getLogger(__name__)


class GoalJournal:
    """One file, replaced atomically, and synced: its volume may outlive the node."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last = ""

    def save(self, ledger: GoalLedger, rules: Sequence[TaskRule]) -> None:
        """Store the goals and the tasks, if they differ from what was stored last. Raises OSError."""
        text = json.dumps({"ledger": ledger.to_wire(), "rules": [asdict(rule) for rule in rules]})
        if text == self._last:
            return
        temporary = self._path.with_suffix(".new")
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, self._path)
        self._last = text

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
