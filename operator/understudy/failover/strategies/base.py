"""The interface of a strategy, and the context that it works with.

Every strategy fences before it routes. An executing standby needs one commit for both. Otherwise the gate closes first, the understudy is
brought up behind it, and the gate then opens for it (the failover protocol, step 4).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from understudy.api.protocol.kept_state import KeptState
from understudy.failover.availability import Availability
from understudy.failover.interfaces import Agents, Gate, Instance, Instances, NotAvailable, Outputs
from understudy.failover.pool_queue import Queue
from understudy.failover.progress import Progress

Unfit = Callable[[Instance], str | None]
"""Returns why an instance may not take over in a planned switchover, for example because of its node; None if it may."""


@dataclass(frozen=True)
class StrategyContext:
    """The context of a strategy: interfaces to the gate, to pods and their agents, a clock, and limits of the workload."""

    gate: Gate
    instances: Instances
    agents: Agents
    outputs: Outputs
    queue: Queue
    clock: Callable[[], float]
    save: Callable[[Progress], None]
    workload_uid: str
    kept: Callable[[float], KeptState] = lambda onset: KeptState()
    """Returns the state for the instance that takes over, given the onset of the failure."""
    restore_within: float = 5.0
    """Seconds that restoring state may take."""
    expiry: float = 0.0
    """Seconds after which the robot can no longer receive what an instance sent behind the closed gate."""
    holds: Callable[[Strategy], str | None] = lambda strategy: None
    """Returns why a strategy is not tried now although it is available; None if it is tried."""


class Strategy(ABC):
    """One way to put an instance in control."""

    name: str
    pool: str = ""
    has_own_instance = False
    """Whether the instance runs for this robot already, so that trying it takes no pod from other robots."""
    makes_pod = False
    """Whether it waits for a new pod, which takes as long as Kubernetes needs."""

    @abstractmethod
    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        """Prepare an understudy to drive, and open the gate for it. Raises NotAvailable."""

    async def make_ready(
        self, progress: Progress, context: StrategyContext, *, within: float, unfit: Unfit
    ) -> Instance:
        """Prepare an understudy to drive while another instance drives, without changing the gate.

        The understudy becomes the target of the progress before anything is done to it. Raises NotAvailable, NotVerified.
        """
        raise NotAvailable(f"strategy {self.name} cannot prepare a new instance while another one is active")

    async def wait(self, progress: Progress, context: StrategyContext, *, within: float) -> None:
        """Wait for the resources that it needs, for as long as the policy allows. Raises NotAvailable.

        ``within`` is the time in seconds within which the strategy must be verified afterwards.
        """
        return

    def available(self, context: StrategyContext, progress: Progress | None = None) -> str | None:
        """Return why it cannot run now; None if it can."""
        found = self.availability(context, progress)
        return None if found.available else found.message

    @abstractmethod
    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        """Return whether it could run now, by the rules that the operator uses too."""

    def available_as_reported(self, context: StrategyContext) -> str | None:
        """Return the same as ``available``, without a request to the API server. Used while nothing has failed."""
        return self.available(context)

    async def refresh(self, context: StrategyContext, progress: Progress | None = None) -> None:
        """Request the state that ``available`` needs, if it is not known yet. Raises NotAvailable if the API server refuses."""
        return


@dataclass(frozen=True)
class Choice:
    """A strategy of the policy, and the time in seconds within which it must be verified."""

    strategy: Strategy
    verify_within: float
