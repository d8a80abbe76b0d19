"""Computes what a pool size means for its robots: risks, waiting, cost and saved downtime."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from pydantic.alias_generators import to_camel

from understudy.advice import monte_carlo, paper_model, shortage_risk
from understudy.advice.demand import Demand
from understudy.cli.common.errors import CommandError


@dataclass(frozen=True)
class Question:
    """The parameters of a calculation. Times in seconds."""

    robots: int
    failures_per_robot_hour: float
    recovery: float
    """Downtime of a robot that finds a fallback."""
    refill: float
    """Time until another fallback replaces a used one."""
    restart: float
    """Downtime of a robot without a fallback."""
    cpu: float
    """CPU of a waiting fallback, as a share of a working instance's."""

    @property
    def demand(self) -> Demand:
        """The failures, and the time for which each uses a fallback."""
        return Demand(self.robots, self.failures_per_robot_hour, self.refill)


@dataclass(frozen=True)
class Outcome:
    """Risks and cost of a pool according to the formulas."""

    fallbacks: int
    window: float
    loss: float
    waiting: float
    wait: float
    """Mean wait of all failures in seconds; infinite if failures are faster than refills."""
    cpu: float
    """Added CPU, as a share of the CPU of all working instances."""
    down: float
    """Mean downtime per failure in seconds, if a robot without a fallback is restarted."""


@dataclass(frozen=True)
class Size:
    """The result of a calculation."""

    question: Question
    outcome: Outcome
    risk: float | None
    """The required risk."""
    risk_of: str
    needed: dict[str, int]
    """By measure, the fewest fallbacks for that risk; empty if no risk is required."""
    trial: monte_carlo.Trials
    paper: paper_model.PaperEstimate

    @property
    def gained(self) -> float:
        """Seconds of downtime per robot and hour that the pool saves, compared with restarts only."""
        return (self.question.restart - self.outcome.down) * self.question.failures_per_robot_hour

    def data(self) -> dict[str, Any]:
        """Return the result as JSON data; infinite values become null. Times in seconds, probabilities and shares from 0 to 1."""
        found = {
            "question": asdict(self.question),
            "offered": self.question.demand.offered,
            "risk": self.risk,
            "risk_of": self.risk_of if self.risk is not None else None,
            "needed": self.needed or None,
            "outcome": asdict(self.outcome),
            "down_time_gained_per_robot_hour": self.gained,
            "trial": asdict(self.trial),
            "paper": asdict(self.paper) | {"chance": self.paper.chance, "interval": paper_model.INTERVAL},
        }
        finite: dict[str, Any] = _finite(found)
        return finite


def outcome(question: Question, fallbacks: int) -> Outcome:
    """Compute the outcome for a number of fallbacks."""
    offered = question.demand.offered
    loss = shortage_risk.loss_risk(offered, fallbacks)
    return Outcome(
        fallbacks=fallbacks,
        window=shortage_risk.window_risk(offered, fallbacks),
        loss=loss,
        waiting=shortage_risk.waiting_risk(offered, fallbacks),
        wait=shortage_risk.mean_wait(offered, fallbacks, question.refill),
        cpu=fallbacks * question.cpu / question.robots,
        down=(1 - loss) * question.recovery + loss * question.restart,
    )


def calculate(question: Question, fallbacks: int | None, risk: float | None, risk_of: str) -> Size:
    """Compute the result for a number of fallbacks, or for the fewest that keep a risk.

    Raises CommandError if no number does.
    """
    needed = {}
    if fallbacks is None:
        assert risk is not None, "one of them is asked for"
        try:
            needed = {
                measure: shortage_risk.fewest_fallbacks(measure, question.demand.offered, risk)
                for measure in shortage_risk.MEASURES
            }
        except ValueError as error:
            raise CommandError(f"--risk: {error}") from error
        fallbacks = needed[risk_of]
    demand = question.demand
    return Size(
        question=question,
        outcome=outcome(question, fallbacks),
        risk=risk,
        risk_of=risk_of,
        needed=needed,
        trial=monte_carlo.simulate(demand, fallbacks, paper_model.INTERVAL),
        paper=paper_model.estimate(demand.rate, question.refill, fallbacks),
    )


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {to_camel(key): _finite(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
