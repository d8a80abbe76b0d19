"""Whether the API server answers: recorded by the client with each request, and read by whoever must not count an outage as time.

Times are of the event loop's clock.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Iterator

SLOW = 0.25
"""Seconds without an answer after which a request under way counts as unanswered. An API server at rest answers in some milliseconds."""

LASTS = 10.0
"""Seconds for which a request without an answer says something about the API server. While that is away, watches ask again at least that
often. A single request may have been lost, and nobody may ask again."""

JUST_BACK = 15.0
"""Seconds after an outage, or after the first answer to this process, for which the API server may not have loaded all that it needs to
know who may do what."""


class ApiContact:
    """The requests of one client that the API server has not answered."""

    def __init__(self) -> None:
        self._asked: dict[object, float] = {}
        """Since when each request is under way."""
        self._failing_since: float | None = None
        """Since when each request that ended has ended without an answer."""
        self._failed_at = -math.inf
        """When a request last ended without an answer."""
        self._answered_at = -math.inf
        """When a request was last answered."""
        self._back_at = -math.inf
        """When a request was first answered at all, or after the last outage."""
        self.returns = 0
        """How often that was."""
        self.last_outage: tuple[float, float] | None = None
        """When the last outage began and ended. One that begins less than JUST_BACK seconds after the one before it continues that one:
        between its first answers, an API server that starts refuses requests."""
        self._back = asyncio.Event()

    @contextlib.contextmanager
    def asking(self) -> Iterator[None]:
        """Record a request while the context is open. It was answered if the context ends without an error. An API server that does
        not know who asks has not answered.

        A request that its sender cancels says nothing about the API server, unless it was under way for long. Neither does
        one without an answer if another request was answered meanwhile: it was lost on the way.
        """
        loop, request = asyncio.get_running_loop(), object()
        self._asked[request] = asked = loop.time()
        try:
            yield
        except BaseException as error:
            failed = isinstance(error, Exception) or loop.time() - asked >= SLOW
            if failed and self._answered_at <= asked:
                self._failing_since = asked if self._failing_since is None else self._failing_since
                self._failed_at = loop.time()
            raise
        else:
            # A process that starts does not know whether the API server has only just started too.
            is_back = self._failing_since is not None or self._answered_at == -math.inf
            began, self._failing_since, self._answered_at = self._failing_since, None, loop.time()
            if began is not None:
                before, ended = self.last_outage or (began, -math.inf)
                self.last_outage = before if began - ended < JUST_BACK else began, self._answered_at
            if is_back:
                self._back_at = self._answered_at
                self.returns += 1
                self._back.set()
                self._back = asyncio.Event()
        finally:
            del self._asked[request]

    async def returned(self, known: int) -> int:
        """Wait until the API server has returned (or has answered at all) more often than ``known`` times. Returns how often it has."""
        while self.returns <= known:
            await self._back.wait()
        return self.returns

    async def pause(self, seconds: float) -> None:
        """Pause for so many seconds before another try, but not longer than until the API server returns."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.returned(self.returns)

    @property
    def unanswered_since(self) -> float | None:
        """Since when the API server answers no request; None while it answers."""
        if self._failing_since is None and not self._asked:
            return None
        now = asyncio.get_running_loop().time()
        if self._failing_since is not None:
            return self._failing_since if self._asked or now - self._failed_at < LASTS else None
        # A request that is under way while others are answered may be lost. What counts is the time without any answer.
        since = max(min(self._asked.values()), self._answered_at)
        return since if now - since >= SLOW else None

    @property
    def just_back(self) -> bool:
        """Whether the API server has answered for less than JUST_BACK seconds, as far as this process knows."""
        return asyncio.get_running_loop().time() - self._back_at < JUST_BACK
