"""What nodes of the active instance report about themselves: changes as they happen, and the present at intervals.

What a node tells has its sender. An answer has none, and a request reaches every node of that name, also a standby's: it
counts where all that could have answered did so and say the same. Nothing here waits: requests are sent, and answers taken,
by the loop that drains subscriptions, with no executor.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import interface_class
from understudy.trees.core.observations import Content, Evidence, TopicRecord, Unreadable

PERIOD = 2.0
"""Seconds between questions. A change is reported at once; what is asked for is what came before, or got lost."""

RETRY = 0.5
"""Seconds between questions while nothing is known: a server that has not found its client yet drops its answer."""

LOOK = 0.1
"""Seconds after which what is known is said again: it is as true of an instance that has just taken control."""

Subject = TypeVar("Subject", bound=Hashable)
"""What is asked about, such as a node."""

Fact = TypeVar("Fact", bound=Hashable)
"""What can be known of it, such as a state."""

Said = TypeVar("Said", bound=Evidence)
"""How that is said to a health tree."""


@dataclass
class _Question(Generic[Fact]):
    """What every server of a name was asked."""

    number: int
    servers: int
    """How many were there, and can be reached."""
    own: bool
    """Whether all of them are of the active instance."""
    answers: list[Fact] = field(default_factory=list)


@dataclass
class _Inquiry(Generic[Fact, Said]):
    """What is known of a subject."""

    client: Any = None
    response: Any = None
    """The class of the answers."""
    fact: Fact | None = None
    """What is so; None if that is not known."""
    blind: str = ""
    """Why it cannot be determined."""
    said: Said | None = None
    of: Fact | None = None
    """The fact that was said."""
    event: object = None
    """The message that was looked into last."""
    servers: frozenset[bytes] | None = None
    """Those of the active instance when they were last looked for, by GID: others are of another process."""
    moved: bool = False
    """Whether it has reported a change since they were."""
    question: _Question[Fact] | None = None
    next: float = 0.0


class Inquiries(ABC, Generic[Subject, Fact, Said]):
    """What is known of some subjects. Times are Unix seconds."""

    def __init__(
        self, graph: Graph, counts: Callable[[bytes], bool], own: Callable[[str], TopicRecord | None], *, alone: bool
    ) -> None:
        """``counts`` says of a GID whether an endpoint of it does, ``own`` what was received from such on a topic; ``alone``
        where no others can be reached.
        """
        self._graph, self._counts, self._own, self._alone = graph, counts, own, alone
        self._inquiries: dict[Subject, _Inquiry[Fact, Said]] = {}

    # -- what is asked about ----------------------------------------------------------------------------------------

    absent: Fact
    """What is so where the active instance has no server of the name."""

    @abstractmethod
    def topic(self, subject: Subject) -> str:
        """Where a node reports changes."""

    @abstractmethod
    def told(self, subject: Subject, content: Content) -> Fact | None:
        """What a message there says of it; None if it says nothing of it. Raises Unreadable."""

    @abstractmethod
    def service(self, subject: Subject) -> tuple[str, str]:
        """The service that tells it, and its type."""

    @abstractmethod
    def request(self, subject: Subject, type_: Any) -> Any:
        """The request to it."""

    @abstractmethod
    def answered(self, answer: Any) -> Fact:
        """What an answer says."""

    @abstractmethod
    def words(self, fact: Fact) -> str:
        """A fact in words, others for each."""

    @abstractmethod
    def blind(self, subject: Subject, nodes: int, found: str) -> str:
        """Why the fact cannot be determined, with the number of nodes in different pods and what they answered."""

    @abstractmethod
    def evidence(self, received: float, fact: Fact | None) -> Said:
        """What was so at a time, for a health tree; None if it cannot be determined."""

    # -- what is known ----------------------------------------------------------------------------------------------

    @property
    def problems(self) -> list[str]:
        """What cannot be determined, in plain words."""
        return [inquiry.blind for inquiry in self._inquiries.values() if inquiry.blind]

    def follow(self, subjects: Iterable[Subject]) -> None:
        """Know of these and no others."""
        subjects = set(subjects)
        for subject in [subject for subject in self._inquiries if subject not in subjects]:
            self._end(self._inquiries.pop(subject))
        for subject in subjects - self._inquiries.keys():
            self._inquiries[subject] = _Inquiry()

    def forget(self) -> None:
        """Forget what is known: another instance is in control now."""
        for subject, inquiry in self._inquiries.items():
            self._inquiries[subject] = _Inquiry(inquiry.client, inquiry.response)

    def look(self) -> None:
        """Take in what has been received, and ask if it is time to."""
        now = time.monotonic()
        for subject, inquiry in self._inquiries.items():
            self._follow_events(subject, inquiry)
            self._take_answers(subject, inquiry)
            if now >= inquiry.next:
                self._ask(subject, inquiry)
                known = inquiry.fact is not None and inquiry.fact != self.absent
                inquiry.next = now + (PERIOD if known else RETRY)
            self._say(inquiry)

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for inquiry in self._inquiries.values():
            if inquiry.said is not None:
                inquiry.said.received += seconds

    def of(self, subject: Subject) -> Said | None:
        """What is known of a subject; None for nothing (yet)."""
        inquiry = self._inquiries.get(subject)
        return inquiry.said if inquiry is not None else None

    def close(self) -> None:
        """End all clients."""
        self.follow(())

    # -- what is told -----------------------------------------------------------------------------------------------

    def _follow_events(self, subject: Subject, inquiry: _Inquiry[Fact, Said]) -> None:
        record = self._own(self.topic(subject))
        if record is None or not record.contents or record.contents[-1] is inquiry.event:
            return
        last, inquiry.event = inquiry.event, record.contents[-1]
        for content in reversed(record.contents):
            if content is last:
                return
            try:
                fact = self.told(subject, content)
            except Unreadable:
                continue
            if fact is not None:
                inquiry.fact, inquiry.blind = fact, ""
                inquiry.question, inquiry.moved = None, True  # answers may be of before
                inquiry.said, inquiry.of = self.evidence(content.received, fact), fact
                return

    # -- what is asked ----------------------------------------------------------------------------------------------

    def _ask(self, subject: Subject, inquiry: _Inquiry[Fact, Said]) -> None:
        if inquiry.question is not None:
            self._conclude(subject, inquiry, inquiry.question)
        service, type_name = self.service(subject)
        ends = self._graph.servers(service)
        own = frozenset(end.gid for end in ends if self._counts(end.gid))
        if inquiry.servers is not None and own != inquiry.servers and not inquiry.moved:
            inquiry.fact, inquiry.blind = None, ""  # of another process nothing is known
        inquiry.servers, inquiry.moved = own, False
        if not own:
            inquiry.fact, inquiry.blind = self.absent, ""
            return
        type_ = interface_class(type_name)
        if inquiry.client is None:
            inquiry.response = type_.Response
            inquiry.client = self._graph.node.create_client(type_, service)
        with inquiry.client.handle:
            number = inquiry.client.handle.send_request(self.request(subject, type_))
        reached = len(own) if self._alone else len(ends)
        inquiry.question = _Question(number, reached, reached == len(own))

    def _take_answers(self, subject: Subject, inquiry: _Inquiry[Fact, Said]) -> None:
        while (question := inquiry.question) is not None:
            with inquiry.client.handle:
                info, answer = inquiry.client.handle.take_response(inquiry.response)
            if info is None:
                return
            if info.request_id.sequence_number != question.number:
                continue  # too late: it is of an earlier question
            question.answers.append(self.answered(answer))
            if len(question.answers) == question.servers:
                self._conclude(subject, inquiry, question)

    def _conclude(self, subject: Subject, inquiry: _Inquiry[Fact, Said], question: _Question[Fact]) -> None:
        """Make of the answers what can be made of them, when all have come or the time is over."""
        inquiry.question = None
        whole = len(question.answers) == question.servers
        words = sorted({self.words(answer) for answer in question.answers})
        if whole and len(words) == 1:
            inquiry.fact, inquiry.blind = question.answers[0], ""
        elif question.own:
            return  # one that does not answer counts as unchanged
        elif inquiry.fact is None or (whole and self.words(inquiry.fact) not in words):
            inquiry.fact = None
            found = f"some are {' and some '.join(words)}" if whole else f"{len(question.answers)} answered"
            inquiry.blind = self.blind(subject, question.servers, found)

    def _say(self, inquiry: _Inquiry[Fact, Said]) -> None:
        if inquiry.fact is None and not inquiry.blind:
            inquiry.said = inquiry.of = None
            return
        now = time.time()
        if inquiry.said is None or inquiry.of != inquiry.fact or now >= inquiry.said.received + LOOK:
            inquiry.said, inquiry.of = self.evidence(now, inquiry.fact), inquiry.fact

    def _end(self, inquiry: _Inquiry[Fact, Said]) -> None:
        if inquiry.client is not None:
            self._graph.node.destroy_client(inquiry.client)
