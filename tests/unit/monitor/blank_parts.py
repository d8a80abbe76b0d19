"""The parts of a monitor that does nothing, for tests of its loop. Each test replaces the parts that it is about."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

from understudy.failover.interfaces import GateState
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.loop import Parts
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import Wakeups


def nothing(*_: Any, **__: Any) -> Any:
    """Do nothing."""
    return


@contextlib.asynccontextmanager
async def meanwhile() -> AsyncIterator[None]:
    """Do nothing beside a recovery."""
    yield


def observer(**more: Any) -> Any:
    """What is seen of a robot of which nothing is heard."""
    blind = dict.fromkeys(("drain", "follow", "outputs", "last_from", "last_well"), nothing)
    return SimpleNamespace(**({"graph": None, "coming": None} | blind | more))


def blank_parts(*, view: Any, pods: Any = None, gate: Any = None, **replaced: Any) -> Parts:
    """Return the parts of a monitor, with these in place of the blank ones."""
    pods = pods or SimpleNamespace(of_workload=list, find=nothing)
    gate = gate or SimpleNamespace(state=GateState(), exists=True, left_by=nothing)
    roles = InstanceRoles(view, gate, CurrentRecovery())
    agents: Any = SimpleNamespace(status=nothing, follow=nothing)
    journal: Any = SimpleNamespace(save=nothing, clear=nothing, given_up=list, give_up=nothing)
    crash_points: Any = SimpleNamespace(step=nothing)
    senses = Senses(
        replaced.pop("observer", None) or observer(),
        replaced.pop("agents", agents),
        replaced.pop("probes", SimpleNamespace()),
        replaced.pop("readership", SimpleNamespace(ungated="")),
        roles,
        Wakeups(),
    )
    blank: dict[str, Any] = {
        "cluster": Cluster(view, pods, gate),
        "senses": senses,
        "keeping": SimpleNamespace(judge=nothing, follow=nothing, select=nothing, tell=nothing, recovering=meanwhile),
        "journal": RecoveryJournal(replaced.pop("journal", journal), crash_points),
        "black_box": SimpleNamespace(begin=nothing, end=nothing),
        "notices": Notices(),
    }
    return Parts(**(blank | replaced))
