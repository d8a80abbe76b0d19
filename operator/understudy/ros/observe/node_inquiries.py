"""Facts that nodes of the active instance report about themselves.

Changes are reported when they happen, and the present state is requested at intervals. An event has a sender. An answer
has none, and a request reaches every node of that name, also a standby's. So answers count only if all nodes that could
have answered did so and agree. Nothing here waits: the loop that drains subscriptions also sends requests and takes
answers, without an executor.
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
"""Seconds between requests. A change is reported at once; requests find the earlier state and changes whose report was
lost."""

RETRY = 0.5
"""Seconds between requests while nothing is known: a server that has not discovered its client yet drops its answer."""

CHECK_PERIOD = 0.1
"""Seconds after which a known fact is reported again with a new time, because it also holds after the instance becomes
active."""

Subject = TypeVar("Subject", bound=Hashable)
"""The subject of a fact, such as a node."""

Fact = TypeVar("Fact", bound=Hashable)
"""A fact about a subject, such as a state."""

EvidenceT = TypeVar("EvidenceT", bound=Evidence)
"""The form of a fact for a health tree."""


@dataclass
class _Question(Generic[Fact]):
    """A request that was sent to every server of a name."""

    number: int
    servers: int
    """Number of servers that existed and can be reached."""
    own: bool
    """Whether all of them belong to the active instance."""
    answers: list[Fact] = field(default_factory=list)


@dataclass
class _Inquiry(Generic[Fact, EvidenceT]):
    """The state of knowledge about a subject."""

    client: Any = None
    response: Any = None
    """The class of the answers."""
    fact: Fact | None = None
    """The fact; None if it is not known."""
    blind: str = ""
    """Why it cannot be determined."""
    evidence: EvidenceT | None = None
    of: Fact | None = None
    """The fact that was reported."""
    event: object = None
    """The last message that was examined."""
    servers: frozenset[bytes] | None = None
    """Servers of the active instance at the last refresh, by GID. Other servers belong to another process."""
    moved: bool = False
    """Whether the subject has reported a change since then."""
    question: _Question[Fact] | None = None
    next: float = 0.0


class Inquiries(ABC, Generic[Subject, Fact, EvidenceT]):
    """Facts about some subjects. Times are Unix seconds."""

    def __init__(
        self, graph: Graph, counts: Callable[[bytes], bool], own: Callable[[str], TopicRecord | None], *, alone: bool
    ) -> None:
        """Observe nothing until :meth:`follow`.

        ``counts`` returns whether the endpoint with a GID counts. ``own`` returns what was received from such endpoints
        on a topic. ``alone`` says that no other nodes can be reached.
        """
        self._graph, self._counts, self._own, self._alone = graph, counts, own, alone
        self._inquiries: dict[Subject, _Inquiry[Fact, EvidenceT]] = {}

    # -- kind of fact ------------------------------------------------------------------------------------------------

    absent: Fact
    """The fact if the active instance has no server of the name."""

    @abstractmethod
    def topic(self, subject: Subject) -> str:
        """Return the topic on which a node reports changes."""

    @abstractmethod
    def from_message(self, subject: Subject, content: Content) -> Fact | None:
        """Return the fact in a message of that topic; None if it has no fact about the subject. Raises Unreadable."""

    @abstractmethod
    def service(self, subject: Subject) -> tuple[str, str]:
        """Return the service that reports the fact, and its type."""

    @abstractmethod
    def request(self, subject: Subject, type_: Any) -> Any:
        """Return the request to that service."""

    @abstractmethod
    def from_answer(self, answer: Any) -> Fact:
        """Return the fact in an answer."""

    @abstractmethod
    def words(self, fact: Fact) -> str:
        """Return a fact as text, different for each fact."""

    @abstractmethod
    def blind(self, subject: Subject, nodes: int, found: str) -> str:
        """Return why the fact cannot be determined, given the number of nodes in different pods and their answers."""

    @abstractmethod
    def evidence(self, received: float, fact: Fact | None) -> EvidenceT:
        """Return the fact at a time, for a health tree; None if it cannot be determined."""

    # -- knowledge ---------------------------------------------------------------------------------------------------

    @property
    def problems(self) -> list[str]:
        """Return what cannot be determined, as text for users."""
        return [inquiry.blind for inquiry in self._inquiries.values() if inquiry.blind]

    def follow(self, subjects: Iterable[Subject]) -> None:
        """Follow these subjects and no others."""
        subjects = set(subjects)
        for subject in [subject for subject in self._inquiries if subject not in subjects]:
            self._end(self._inquiries.pop(subject))
        for subject in subjects - self._inquiries.keys():
            self._inquiries[subject] = _Inquiry()

    def forget(self) -> None:
        """Forget all facts, because another instance has become active."""
        for subject, inquiry in self._inquiries.items():
            self._inquiries[subject] = _Inquiry(inquiry.client, inquiry.response)

    def refresh(self) -> None:
        """Process what has been received, and send requests that are due."""
        now = time.monotonic()
        for subject, inquiry in self._inquiries.items():
            self._follow_events(subject, inquiry)
            self._take_answers(subject, inquiry)
            if now >= inquiry.next:
                self._ask(subject, inquiry)
                known = inquiry.fact is not None and inquiry.fact != self.absent
                inquiry.next = now + (PERIOD if known else RETRY)
            self._update_evidence(inquiry)

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for inquiry in self._inquiries.values():
            if inquiry.evidence is not None:
                inquiry.evidence.received += seconds

    def of(self, subject: Subject) -> EvidenceT | None:
        """Return the fact about a subject; None if nothing is known (yet)."""
        inquiry = self._inquiries.get(subject)
        return inquiry.evidence if inquiry is not None else None

    def close(self) -> None:
        """Remove all clients."""
        self.follow(())

    # -- events ------------------------------------------------------------------------------------------------------

    def _follow_events(self, subject: Subject, inquiry: _Inquiry[Fact, EvidenceT]) -> None:
        record = self._own(self.topic(subject))
        if record is None or not record.contents or record.contents[-1] is inquiry.event:
            return
        last, inquiry.event = inquiry.event, record.contents[-1]
        for content in reversed(record.contents):
            if content is last:
                return
            try:
                fact = self.from_message(subject, content)
            except Unreadable:
                continue
            if fact is not None:
                inquiry.fact, inquiry.blind = fact, ""
                inquiry.question, inquiry.moved = None, True  # answers may be older than the event
                inquiry.evidence, inquiry.of = self.evidence(content.received, fact), fact
                return

    # -- requests ----------------------------------------------------------------------------------------------------

    def _ask(self, subject: Subject, inquiry: _Inquiry[Fact, EvidenceT]) -> None:
        if inquiry.question is not None:
            self._conclude(subject, inquiry, inquiry.question)
        service, type_name = self.service(subject)
        ends = self._graph.servers(service)
        own = frozenset(end.gid for end in ends if self._counts(end.gid))
        if inquiry.servers is not None and own != inquiry.servers and not inquiry.moved:
            inquiry.fact, inquiry.blind = None, ""  # the new process may have another fact
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

    def _take_answers(self, subject: Subject, inquiry: _Inquiry[Fact, EvidenceT]) -> None:
        while (question := inquiry.question) is not None:
            with inquiry.client.handle:
                info, answer = inquiry.client.handle.take_response(inquiry.response)
            if info is None:
                return
            if info.request_id.sequence_number != question.number:
                continue  # a late answer to an earlier request
            question.answers.append(self.from_answer(answer))
            if len(question.answers) == question.servers:
                self._conclude(subject, inquiry, question)

    def _conclude(self, subject: Subject, inquiry: _Inquiry[Fact, EvidenceT], question: _Question[Fact]) -> None:
        """Evaluate the answers, when all have arrived or the time is over."""
        inquiry.question = None
        whole = len(question.answers) == question.servers
        words = sorted({self.words(answer) for answer in question.answers})
        if whole and len(words) == 1:
            inquiry.fact, inquiry.blind = question.answers[0], ""
        elif question.own:
            return  # a node that does not answer counts as unchanged
        elif inquiry.fact is None or (whole and self.words(inquiry.fact) not in words):
            inquiry.fact = None
            found = f"some are {' and some '.join(words)}" if whole else f"{len(question.answers)} answered"
            inquiry.blind = self.blind(subject, question.servers, found)

    def _update_evidence(self, inquiry: _Inquiry[Fact, EvidenceT]) -> None:
        if inquiry.fact is None and not inquiry.blind:
            inquiry.evidence = inquiry.of = None
            return
        now = time.time()
        if inquiry.evidence is None or inquiry.of != inquiry.fact or now >= inquiry.evidence.received + CHECK_PERIOD:
            inquiry.evidence, inquiry.of = self.evidence(now, inquiry.fact), inquiry.fact

    def _end(self, inquiry: _Inquiry[Fact, EvidenceT]) -> None:
        if inquiry.client is not None:
            self._graph.node.destroy_client(inquiry.client)
