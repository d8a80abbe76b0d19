"""The judge stage of one workload: its parts, put together."""

from __future__ import annotations

from understudy.failover.interfaces import Gate, Instances
from understudy.monitor.judge.degradation_level import Levels
from understudy.monitor.judge.failure_detection import Detector
from understudy.monitor.judge.gate_enforcement import Enforcement
from understudy.monitor.judge.situation_tracking import Situations
from understudy.monitor.notices import Notices
from understudy.monitor.observe.senses import Senses


class JudgeStage:
    """What the observations say about the active instance and the gate."""

    def __init__(self, pods: Instances, gate: Gate, senses: Senses, notices: Notices) -> None:
        self.detector = Detector(pods, gate, senses.sidecars, senses.sight)
        self.levels = Levels(senses.sight, notices)
        self.situations = Situations(senses.sight, notices)
        self.enforcement = Enforcement(gate, senses.probes, notices, lambda: senses.readership.ungated)
