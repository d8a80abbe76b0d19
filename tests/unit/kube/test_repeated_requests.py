"""Requests that a recovery cannot do without: repeated until the API server answers, also if a connection is dead."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from understudy.kube import repeated_requests
from understudy.kube.client import ApiError
from understudy.kube.repeated_requests import answered

HANGS = "hangs"


def asking(answers: list[Exception | str]) -> Callable[[], Awaitable[str]]:
    """A request that is answered with one after the other, fails with it, or is never answered."""

    async def ask() -> str:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        if answer == HANGS:
            await asyncio.Event().wait()
        return answer

    return ask


async def test_a_request_is_repeated_until_it_is_answered_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeated_requests, "RETRY_FIRST", 0.001)
    answers: list[Exception | str] = [TimeoutError(), ApiError(429, "TooManyRequests", "busy"), "pods"]
    assert await answered(asking(answers)) == "pods"
    answers = [ApiError(403, "Forbidden", "no"), "pods"]
    with pytest.raises(ApiError):
        await answered(asking(answers))
    assert answers == ["pods"], "it isn't asked again"


async def test_a_request_on_a_dead_connection_is_sent_again() -> None:
    assert await answered(asking([HANGS, HANGS, "pods"]), within=0.02) == "pods"


async def test_the_pauses_stay_short_during_a_long_outage(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(repeated_requests.asyncio, "sleep", sleep)
    outage: list[Exception | str] = [OSError("away")] * 100
    assert await answered(asking([*outage, "pods"])) == "pods"
    assert max(pauses) <= 0.25, "an executing standby drives within 500 ms of the return of the API server"


async def test_a_server_that_does_not_know_roles_or_accounts_yet_is_asked_again() -> None:
    answers: list[Exception | str] = [
        ApiError(
            403,
            "Forbidden",
            'cannot delete resource "pods": RBAC: role.rbac.authorization.k8s.io "w-monitor" not found',
        ),
        ApiError(401, "Unauthorized", "Unauthorized"),
        "deleted",
    ]
    assert await answered(asking(answers)) == "deleted"
    answers.append(ApiError(403, "Forbidden", "only pods of its own workload"))
    with pytest.raises(ApiError):
        await answered(asking(answers))
