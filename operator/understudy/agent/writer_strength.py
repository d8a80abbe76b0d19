"""Ownership strengths of the instance's writers, for robots whose readers choose the strongest writer.

A process reads its strength from the pod's profiles when it starts. A restarted container must not have the strength of
its first start, or it would take the robot back from the standby that took over. So as soon as the application is up,
the file is kept at the strength of a process that starts now. That does not make running processes weaker.

A process that starts after a standby took over must not be heard at all, not even if the standby is late. Its writers
then offer no deadline, and no reader on the robot's side accepts that.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from understudy.api import names
from understudy.api.protocol.ownership_strength import strength
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)

NAME = "strength.json"
_VALUE = re.compile(r"(<ownershipStrength><value>)(\d+)(</value></ownershipStrength>)")
_DEADLINE = re.compile(r"<deadline>.*?</deadline>", re.DOTALL)
_PROCESS = slice(0, 12)
"""The part of a writer's GID that is the same for all writers of a process: the GUID prefix of its participant."""


class WriterStrengths:
    """The strengths of a pod, as long as the pod lives."""

    def __init__(self, directory: Path, *, memory: Path | None = None, clock: Callable[[], float] = time.time) -> None:
        """``directory`` contains the profiles. ``memory`` is the agent's own directory, if it has one."""
        self._directory, self._memory, self._clock = directory, memory or directory, clock
        self._known: set[str] = set()
        self.range: tuple[int, int] | None = None
        """Lowest and highest strength of the instance's writers; None if it has none (yet)."""
        try:
            kept = json.loads((self._memory / NAME).read_text())
            self._known, self.range = set(kept["processes"]), (int(kept["least"]), int(kept["most"]))
        except FileNotFoundError:
            pass
        except (OSError, ValueError, KeyError, TypeError) as error:
            _logger.error("%s cannot be read, continuing without: %s", self._memory / NAME, error)

    def saw(self, writers: Iterable[bytes]) -> bool:
        """Note the GIDs of the instance's writers. Returns whether the range changed.

        A full volume must not end an agent.
        """
        processes = {gid[_PROCESS].hex() for gid in writers}
        if not processes:
            return False
        path, before = self._directory / names.PROFILES_KEY, self.range
        try:
            text = path.read_text()
            written = _VALUE.search(text)
            if written is None:
                return False
            now = strength(self._clock())
            if processes - self._known:
                # The first processes have read the present file. Later ones may have read it before it was last
                # changed. The agent does not know which of the writers a reader hears, so it reports a range that is
                # right for all of them.
                first = int(written[2])
                self.range = (min(now, self.range[0]), self.range[1]) if self.range else (first, first)
                self._known |= processes
                self._keep(self.range)
            if now < int(written[2]):
                replace_file(path, _VALUE.sub(rf"\g<1>{now}\g<3>", text), mode=0o644)
        except FileNotFoundError:
            return False
        except OSError as error:
            _logger.error(
                "%s: could not store the DDS ownership strength, so a restarted process would have the same strength as this one: %s",
                path,
                error,
            )
        return self.range != before

    def give_way(self) -> None:
        """Prevent processes that start from now on from being heard by the robot. Running ones are not changed.

        Raises OSError.
        """
        path = self._directory / names.PROFILES_KEY
        with contextlib.suppress(FileNotFoundError):
            text = path.read_text()
            if _VALUE.search(text) and _DEADLINE.search(text):
                replace_file(path, _DEADLINE.sub("", text), mode=0o644)

    def _keep(self, found: tuple[int, int]) -> None:
        kept = {"processes": sorted(self._known), "least": found[0], "most": found[1]}
        replace_file(self._memory / NAME, json.dumps(kept), mode=0o600)
