"""Marks abandoned recoveries, so that a recovery record left next to a gate is not mistaken for one in progress."""

from __future__ import annotations

from understudy.api.base import Model
from understudy.failover.progress import Progress, beside


class AbandonedRecovery(Model):
    """What may stand beside a gate of a recovery that was given up."""

    id: str
    epoch: int
    """The gate's by the last of its commits that is known to have been carried out, or when it was taken up."""
    sent: str
    """The text of the last one that was sent, which may be carried out still."""

    def matches(self, epoch: int, text: str) -> bool:
        """Whether a gate with this epoch and this text reports the recovery as in progress.

        Another monitor may have continued it since, under the same id. What that monitor has committed is not abandoned.
        """
        found = beside(text)
        ours = epoch == self.epoch or text == self.sent
        return found is not None and (found.id, found.result) == (self.id, "Running") and ours

    def may_still_commit(self, epoch: int) -> bool:
        """Whether a gate of this epoch may still show its commit: a commit replaces what its sender knew, and nothing newer."""
        return epoch <= self.epoch


def ended(progress: Progress) -> Progress:
    """Return the record of an abandoned recovery for a gate. It still names the pods that had failed."""
    return progress.model_copy(update={"result": "Failed", "strategy": "", "waiting": None})
