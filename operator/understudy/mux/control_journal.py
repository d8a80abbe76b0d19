"""The file with the control of one workload, so that a mux that restarts forwards the same instance and refuses the same orders."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path

from understudy.api.protocol.mux_messages import Token, read_standing, standing_message
from understudy.mux.control import Control
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)


class ControlJournal:
    """One file, replaced atomically and synced: also a lost node must not bring back who was fenced."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def save(self, control: Control) -> None:
        """Store the control. Raises OSError, and then nothing is stored."""
        text = json.dumps(asdict(control) | {"standing": standing_message(control.standing)})
        replace_file(self._path, text, synced=True)

    def load(self) -> Control:
        """Return what was stored; nobody is forwarded if nothing was.

        A damaged file is moved aside, and nobody is forwarded until the next order.
        """
        try:
            found = json.loads(self._path.read_text())
            return Control(
                Token(**found["token"]),
                found["source"],
                found["ordered"],
                read_standing(found["standing"]),
                found["revision"],
                tuple(found["replaced"]),
                found["on_board"],
            )
        except FileNotFoundError:
            return Control()
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            _logger.error("%s cannot be read, so nobody is forwarded until the next order: %r", self._path, error)
            if self._path.exists():
                self._path.replace(self._path.with_suffix(".damaged"))
            return Control()
