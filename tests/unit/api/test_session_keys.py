"""The keys of a session, and the lines that they authenticate. The vectors fix both for other versions of monitor and agent."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
from dataclasses import astuple
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.api.protocol.session_keys import LineAuthentication, NotAuthentic, SessionKeys, derive, legacy_proof

SESSION: dict[str, Any] = {
    "uid": "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10",
    "agent_nonce": "2:000102030405060708090a0b0c0d0e0f",
    "monitor_nonce": "101112131415161718191a1b1c1d1e1f",
    "workload": "robot-17",
    "claim": "b6c1/3",
}
TOKEN = b"correct horse battery staple"

VECTORS = [
    "d1e4f798761ca2f1e7b668fc9443f42188667f22aa4c7e72815ce652d5faf9a1",
    "6e982bc62f4ee8f7e53d480503f573c6d4bef892ad0ab9934accdf3720d62fde",
    "ef4fc79a5dff17b9d8a5383720fb5da9eedcb08693a4136d48d4c16344c0c32e",
    "1df2985b0d72b62a89ca01cc3ce3363cdcbe4415f568a96d4ce75269e90b7bba",
    "4e14bedc6189031daa64b146df0796ceef264d0f5d5b24692d6155926b38c2b1",
]
"""The proofs of monitor and agent, the keys for lines to the agent and to the monitor, and the key for probes."""

SEALED = [
    b'044873db95294a68d0c4f1c2d01acff4 {"id":1}\n',
    b'46c2a2477d84dbe98befebe9e3e31c70 {"id":1}\n',
]

TEXTS = st.text(max_size=12)
SESSIONS = st.fixed_dictionaries(dict.fromkeys(SESSION, TEXTS) | {"token": st.binary(max_size=12)})
LINES = st.lists(st.binary(max_size=40), min_size=1, max_size=6)


def keys(token: bytes = TOKEN, **changed: str) -> SessionKeys:
    return derive(token, **{**SESSION, **changed})


def hkdf(token: bytes, salt: bytes, info: bytes) -> bytes:
    """One block of HKDF, in the words of RFC 5869."""
    extracted = hmac.new(salt, token, hashlib.sha256).digest()
    return hmac.new(extracted, info + bytes([1]), hashlib.sha256).digest()


def test_the_keys_have_the_agreed_values() -> None:
    texts = ["proof of the monitor", *SESSION.values()]
    info = b"".join(len(text).to_bytes(4, "big") + text.encode() for text in texts)
    found = keys()
    assert found.monitor_proof == hkdf(TOKEN, b"understudy agent session, version 2", info).hex()
    assert [value if isinstance(value, str) else value.hex() for value in astuple(found)] == VECTORS


def test_lines_have_the_agreed_form() -> None:
    sending = LineAuthentication(keys().to_agent)
    assert [sending.seal(b'{"id":1}\n') for _ in range(2)] == SEALED


def test_the_proof_of_version_1_has_the_agreed_value() -> None:
    expected = hmac.new(TOKEN, b"n\nrobot-17\nb6c1/3", hashlib.sha256).hexdigest()
    assert legacy_proof(TOKEN, "n", "robot-17", "b6c1/3") == expected


@settings(deadline=None)
@given(SESSIONS, SESSIONS)
def test_sessions_that_differ_in_anything_have_no_key_in_common(one: dict[str, Any], other: dict[str, Any]) -> None:
    (first, second) = (set(astuple(derive(**session))) for session in (one, other))
    assert len(first) == len(second) == 5, "a key for each use"
    # HMAC fills a short key with zeros, so a token that ends in zeros has an equal. Tokens are random texts.
    same = {**one, "token": one["token"].rstrip(b"\0")} == {**other, "token": other["token"].rstrip(b"\0")}
    assert same or not first & second


@settings(deadline=None)
@given(TEXTS, TEXTS, TEXTS)
def test_text_that_moves_from_one_field_to_the_next_changes_the_keys(workload: str, moved: str, claim: str) -> None:
    one, other = keys(workload=workload + moved, claim=claim), keys(workload=workload, claim=moved + claim)
    assert (one == other) == (not moved)


def test_keys_are_not_in_representations() -> None:
    found = keys()
    assert found.to_agent.hex() not in repr(found)
    assert repr(found.to_agent) not in repr(found)


@settings(deadline=None)
@given(LINES)
def test_lines_arrive_as_they_were_sent(lines: list[bytes]) -> None:
    sending, receiving = LineAuthentication(b"key"), LineAuthentication(b"key")
    assert [receiving.open(sending.seal(line)) for line in lines] == lines


@settings(deadline=None)
@given(LINES, st.data())
def test_no_line_passes_that_is_changed_repeated_missing_or_moved(lines: list[bytes], data: st.DataObject) -> None:
    sending, receiving = LineAuthentication(b"key"), LineAuthentication(b"key")
    sent = [sending.seal(line) for line in lines]
    arriving = data.draw(st.permutations(sent) | st.lists(st.sampled_from(sent), max_size=8))
    position = data.draw(st.integers(0, len(arriving)))
    if arriving and position < len(arriving) and data.draw(st.booleans()):
        changed = bytearray(arriving[position])
        changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
        arriving[position] = bytes(changed)
    passed: list[bytes] = []
    with contextlib.suppress(NotAuthentic):
        passed.extend(receiving.open(line) for line in arriving)
    assert passed == lines[: len(passed)], "only what was sent, from the first line on"


@pytest.mark.parametrize("line", [b"", b"\n", b"{}\n", b"0" * 32, b"0" * 32 + b" ", b"\xff" * 40])
def test_a_line_without_the_right_mac_is_refused(line: bytes) -> None:
    with pytest.raises(NotAuthentic, match="line 1 of the session"):
        LineAuthentication(b"key").open(line)


def test_the_lines_of_one_direction_do_not_pass_in_the_other() -> None:
    found = keys()
    with pytest.raises(NotAuthentic):
        LineAuthentication(found.to_monitor).open(LineAuthentication(found.to_agent).seal(b"{}\n"))


def test_a_line_is_not_authenticated_with_an_empty_key() -> None:
    with pytest.raises(ValueError, match="empty"):
        LineAuthentication(b"")
