"""A monitor's loop with its real parts, over the objects and senses that a test gives."""

from __future__ import annotations

from pathlib import Path

from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenSenses
from understudy.failover.journal import Journal
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.recording_archive import RecordingArchive
from understudy.state.state_store import StateStore


class GivenMonitor:
    """The monitor of one workload."""

    def __init__(
        self,
        folder: Path,
        *,
        workload: str = "w",
        notices: RecordedNotices | None = None,
        journal: Journal | None = None,
        state_manager: StateManager | None = None,
    ) -> None:
        """``folder`` outlasts it, as the volume of a monitor's pod does."""
        self.objects = ClusterObjects(folder, workload=workload, notices=notices)
        self.notices, self.view = self.objects.notices, self.objects.view
        self.senses = GivenSenses(self.objects)
        self.observer, self.agents = self.senses.observer, self.senses.agents
        self.journal = journal or Journal(folder / "recovery.json")
        self.state_manager = state_manager or StateManager(
            self.observer.graph, StateStore(folder / "kept"), self.agents, self.notices
        )
        archive = RecordingArchive(folder / "recordings")
        self.parts = Parts(
            cluster=self.objects.cluster,
            senses=self.senses.value,
            state_manager=self.state_manager,
            journal=RecoveryJournal(self.journal, self.objects.crash_points),
            black_box=BlackBox(self.view, self.observer, self.notices, archive),
            notices=self.notices,
        )
        self.loop = MonitorLoop(self.parts)
