"""The parts of a monitor that does nothing, for tests of its loop. Each test replaces the parts that it is about."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from understudy.failover.interfaces import GateState
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.loop import Parts
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.wakeups import Wakeups


def nothing(*_: Any, **__: Any) -> Any:
    """Do nothing."""
    return


def blank_parts(*, view: Any, pods: Any = None, gate: Any = None, **replaced: Any) -> Parts:
    """Return the parts of a monitor, with these in place of the blank ones."""
    pods = pods or SimpleNamespace(of_workload=list, find=nothing)
    gate = gate or SimpleNamespace(state=GateState(), exists=True, left_by=nothing)
    current = CurrentRecovery()
    blank: dict[str, Any] = {
        "wakeups": Wakeups(),
        "cluster": Cluster(view, pods, gate),
        "current": current,
        "roles": InstanceRoles(view, gate, current),
        "sidecars": SimpleNamespace(status=nothing, follow=nothing),
        "sight": SimpleNamespace(
            graph=None, coming=None, drain=nothing, follow=nothing, last_from=nothing, last_well=nothing
        ),
        "probes": SimpleNamespace(),
        "notices": Notices(),
        "journal": SimpleNamespace(save=nothing, clear=nothing, given_up=list, give_up=nothing),
        "crash_points": SimpleNamespace(step=nothing),
        "keeping": SimpleNamespace(judge=nothing, follow=nothing),
        "black_box": SimpleNamespace(begin=nothing, end=nothing),
    }
    return Parts(**(blank | replaced))
