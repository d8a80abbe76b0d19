"""Leaves that evaluate the contents of a topic's messages."""

from __future__ import annotations

from understudy.trees.core.evidence import EvidenceLeaf, EvidenceTrack
from understudy.trees.core.observations import Content


class ContentLeaf(EvidenceLeaf[Content]):
    """Holds while the contents of the messages meet its condition."""

    every = False
    """Whether each message is evaluated, and not only the newest one at each evaluation."""

    def fresh(self, track: EvidenceTrack[Content]) -> list[Content]:
        """Return the instance's messages that have not been evaluated, oldest first."""
        record = self._evaluation.observations.topic(self.topic)
        if record is None or not record.contents or record.contents[-1] is track.last_evaluated:
            return []
        found: list[Content] = []
        for content in reversed(record.contents):
            if content is track.last_evaluated or content.received < self._evaluation.since:
                break
            found.append(content)
            if not self.every:
                break
        return found[::-1]
