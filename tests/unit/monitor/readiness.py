"""Procedures, pools and instances of one workload, for tests of how instances are brought to their readiness."""

from __future__ import annotations

from tests.unit.monitor.cluster_objects import settings_of
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.interfaces import Instance

UP = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "active"}}}
INIT = Procedure(yaml={"set_lifecycle": {"node": "/nav", "state": "inactive"}}, within="7s")
CHECK = Check(yaml={"lifecycle_is": {"node": "/nav", "state": "inactive"}}, period="2s")
ACTIVE = Instance("w-1", "uid-1", running=True)
SOURCE = Instance("w-2", "uid-2", running=True, ready=True)
STANDBY = Instance("w-3", "uid-3", pool="warm", running=True, ready=True)
WARM = PoolChoice(name="warm", readiness="Initialized", initialization=INIT, readiness_check=CHECK)
HOT = PoolChoice(name="hot", readiness="Executing")
XML_CHECK = """<root BTCPP_format="4">
<BehaviorTree ID="Ready">
<LifecycleIs node="/nav" state="inactive"/>
</BehaviorTree>
</root>"""


def settings(*pools: PoolChoice) -> WorkloadSettings:
    """Return the settings of a workload with these pools."""
    return settings_of(pools=list(pools))
