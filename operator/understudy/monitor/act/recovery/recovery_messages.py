"""Finished recoveries and planned switchovers in one line, for Events, conditions and logs."""

from __future__ import annotations

from datetime import datetime

from understudy.api.kinds.robot_workload import Recovery


def describe(recovery: Recovery) -> str:
    """Describe a finished recovery in one line, for Events and logs."""
    tried = "; ".join(f"{a.strategy}: {a.result}{f' ({a.message})' if a.message else ''}" for a in recovery.attempts)
    if recovery.result != "Recovered" and recovery.to_pod:
        return f"{recovery.reason}. {recovery.to_pod} is active, but it is not the only one that drives: {tried}"
    if recovery.result != "Recovered" or recovery.recovery_seconds is None:
        return f"{recovery.reason}. Every strategy was tried, and none was verified: {tried}"
    if recovery.follows and len(recovery.attempts) == 1 and not recovery.from_pod:
        return (
            f"{recovery.reason}. {recovery.to_pod} is active again after {recovery.strategy}, which took "
            f"{recovery.recovery_seconds:.3f} s (gate epoch {recovery.epoch})"
        )
    text = (
        f"{recovery.reason}. {recovery.to_pod} took over from {recovery.from_pod or 'no pod'} with strategy {recovery.strategy} "
        f"in {recovery.recovery_seconds:.3f} s (gate epoch {recovery.epoch})"
    )
    if (waited := _waited(recovery)) is not None:
        text = f"{text}, including {waited:.1f} s of waiting for a pod"
    if recovery.moments.held is not None:
        text = f"{text}. limits.budget had deferred the recovery since {recovery.moments.held[11:19]} UTC"
    failed = unverified(recovery)
    return f"{text}. Before that: {'; '.join(failed)}" if failed else text


def describe_switchover(recovery: Recovery) -> str:
    """Describe a planned switchover in one line, for Events and logs."""
    last, first = recovery.moments.last_output, recovery.moments.first_output
    if recovery.result != "Recovered":
        tried = "; ".join(a.message for a in recovery.attempts if a.message)
        active = f"{recovery.to_pod} is active" if recovery.to_pod else f"{recovery.from_pod} can reach the robot again"
        return f"{recovery.reason}. {active}: {tried}"
    text = (
        f"{recovery.reason}. {recovery.to_pod} took over from {recovery.from_pod} with strategy {recovery.strategy} "
        f"(gate epoch {recovery.epoch})"
    )
    if last is None or first is None:
        return text
    gap = (datetime.fromisoformat(first) - datetime.fromisoformat(last)).total_seconds()
    return f"{text}. The robot received no command for {max(0.0, gap):.3f} s"


def _waited(recovery: Recovery) -> float | None:
    """Return the seconds that the recovery waited for a pod of a shared pool; None if it did not wait."""
    queued, claimed = recovery.moments.queued, recovery.moments.claimed
    if queued is None or claimed is None:
        return None
    return (datetime.fromisoformat(claimed) - datetime.fromisoformat(queued)).total_seconds()


def unverified(recovery: Recovery) -> list[str]:
    """Describe the strategies that were carried out and not verified, each with its pod and the reason."""
    return [
        f"{a.strategy} with {a.pod or 'no pod'} did not succeed: {a.message}"
        for a in recovery.attempts
        if a.result == "NotVerified"
    ]
