"""Since when the API server does not answer, by the requests of a client."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from understudy.kube import api_contact
from understudy.kube.api_contact import ApiContact


@pytest.fixture(autouse=True)
def slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_contact, "SLOW", 0.05)


async def fails(contact: ApiContact) -> None:
    with contextlib.suppress(TimeoutError), contact.asking():
        raise TimeoutError


async def test_an_outage_begins_with_the_first_request_that_fails_and_ends_with_an_answer() -> None:
    contact = ApiContact()
    assert contact.unanswered_since is None
    began = asyncio.get_running_loop().time()
    await fails(contact)
    await asyncio.sleep(0.01)
    await fails(contact)
    assert contact.unanswered_since == pytest.approx(began, abs=0.005)
    assert contact.last_outage is None
    with contact.asking():
        pass
    assert contact.unanswered_since is None
    assert contact.last_outage == (
        pytest.approx(began, abs=0.005),
        pytest.approx(asyncio.get_running_loop().time(), abs=0.005),
    )


async def test_an_outage_that_follows_another_one_at_once_continues_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """For how long the network may be late depends on how long the outage was (strategies/steps.py)."""
    monkeypatch.setattr(api_contact, "JUST_BACK", 0.05)
    contact, loop = ApiContact(), asyncio.get_running_loop()

    async def outage(seconds: float) -> None:
        await fails(contact)
        await asyncio.sleep(seconds)
        with contact.asking():
            pass

    began = loop.time()
    await outage(0.02)
    await outage(0.0)
    assert contact.last_outage == (pytest.approx(began, abs=0.005), pytest.approx(loop.time(), abs=0.005))
    await asyncio.sleep(0.06)
    began = loop.time()
    await outage(0.0)
    assert contact.last_outage == (pytest.approx(began, abs=0.005), pytest.approx(loop.time(), abs=0.005))


async def test_a_request_that_was_lost_says_nothing_any_more_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strategy waited for the end of an outage that was none, because nobody asked again (seed 742198)."""
    monkeypatch.setattr(api_contact, "LASTS", 0.1)
    contact = ApiContact()
    await fails(contact)
    assert contact.unanswered_since is not None
    await asyncio.sleep(0.12)
    assert contact.unanswered_since is None
    with contact.asking():
        assert contact.unanswered_since is not None, "one that is under way may be the next without an answer"


async def test_a_request_that_takes_long_is_unanswered_while_it_is_under_way() -> None:
    contact, loop = ApiContact(), asyncio.get_running_loop()
    with contact.asking():
        began = loop.time()
        assert contact.unanswered_since is None
        await asyncio.sleep(0.06)
        assert contact.unanswered_since == pytest.approx(began, abs=0.005)
    assert contact.unanswered_since is None


async def test_a_lost_request_is_no_outage_if_another_one_was_answered_meanwhile() -> None:
    contact = ApiContact()
    with contextlib.suppress(TimeoutError), contact.asking():
        await asyncio.sleep(0.01)
        with contact.asking():
            pass
        raise TimeoutError
    assert contact.unanswered_since is None


async def test_a_lost_request_that_is_still_under_way_is_no_outage_while_others_are_answered() -> None:
    contact = ApiContact()
    with contact.asking():
        for _ in range(5):
            await asyncio.sleep(0.02)
            with contact.asking():
                pass
        assert contact.unanswered_since is None


async def test_an_outage_that_begins_after_an_answer_counts_from_that_answer_for_an_earlier_request() -> None:
    contact, loop = ApiContact(), asyncio.get_running_loop()
    with contact.asking():
        await asyncio.sleep(0.02)
        with contact.asking():
            pass
        answered = loop.time()
        await asyncio.sleep(0.06)
        assert contact.unanswered_since == pytest.approx(answered, abs=0.005)


@pytest.mark.parametrize(("after", "unanswered"), [(0.0, False), (0.06, True)])
async def test_a_cancelled_request_counts_only_if_it_waited_for_long(after: float, unanswered: bool) -> None:
    contact = ApiContact()

    async def ask() -> None:
        with contact.asking():
            await asyncio.sleep(10)

    asking = asyncio.create_task(ask())
    await asyncio.sleep(after)
    asking.cancel()
    await asyncio.gather(asking, return_exceptions=True)
    assert (contact.unanswered_since is not None) == unanswered


async def test_the_api_server_is_just_back_for_a_while_after_an_outage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_contact, "JUST_BACK", 0.05)
    contact = ApiContact()

    def answered() -> bool:
        with contact.asking():
            pass
        return contact.just_back

    assert answered(), "who starts does not know whether the API server has just started too"
    await asyncio.sleep(0.06)
    assert not answered()
    await fails(contact)
    assert not contact.just_back
    assert answered()
    assert answered(), "one answer does not end it"
    await asyncio.sleep(0.06)
    assert not answered()


async def test_a_pause_between_two_tries_ends_when_another_request_is_answered() -> None:
    contact, loop = ApiContact(), asyncio.get_running_loop()
    await fails(contact)
    began = loop.time()
    pausing = asyncio.create_task(contact.pause(60.0))
    await asyncio.sleep(0.02)
    assert not pausing.done()
    with contact.asking():
        pass
    await asyncio.wait_for(pausing, 1)
    await contact.pause(0.02)
    assert 0.03 <= loop.time() - began < 5.0, "a pause lasts its time if there was no outage"


async def test_each_return_is_noticed_by_everybody_who_waits() -> None:
    contact = ApiContact()
    waiting = [asyncio.create_task(contact.returned(0)) for _ in range(2)]
    await asyncio.sleep(0)
    with contact.asking():
        pass
    assert await asyncio.gather(*waiting) == [1, 1]
    await fails(contact)
    with contact.asking():
        pass
    assert await contact.returned(1) == 2
