"""Marks abandoned recoveries, so that a recovery record left next to a gate is not mistaken for one in progress."""

from __future__ import annotations

from understudy.api.base import Model
from understudy.failover.progress import Progress, beside


class AbandonedRecovery(Model):
    """The record of an abandoned recovery that may still be next to a gate."""

    id: str
    epoch: int
    """The gate's epoch after the last commit that is known to have been carried out, or when the recovery was continued."""
    sent: str
    """The text of the last commit that was sent. The API server may still carry it out."""

    def matches(self, epoch: int, text: str) -> bool:
        """Return whether a gate with this epoch and this text reports the recovery as in progress.

        Another monitor may have continued the recovery under the same id. What that monitor committed is not abandoned.
        """
        found = beside(text)
        ours = epoch == self.epoch or text == self.sent
        return found is not None and (found.id, found.result) == (self.id, "Running") and ours

    def may_still_commit(self, epoch: int) -> bool:
        """Return whether a gate at this epoch may still receive this recovery's commit: a commit replaces only the state that its sender
        knew.
        """
        return epoch <= self.epoch


def ended(progress: Progress) -> Progress:
    """Return the record of an abandoned recovery for a gate. It still names the pods that had failed."""
    return progress.model_copy(update={"result": "Failed", "strategy": "", "waiting": None})
