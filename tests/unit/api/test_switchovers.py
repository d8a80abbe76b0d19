"""How a switchover is asked for."""

from __future__ import annotations

import pytest

from understudy.api.kinds.switchover_spec import Verb, parse, request

AT = 1795356131.123456


@pytest.mark.parametrize(("verb", "kind"), [("failover", "Failover"), ("failback", "Failback")])
def test_a_request_is_unchanged_by_encoding_and_decoding(verb: Verb, kind: str) -> None:
    text = request(verb, AT)
    found = parse(text)
    assert (found.text, found.kind, found.at) == (text, kind, pytest.approx(AT, abs=1e-6))


def test_two_requests_are_never_equal() -> None:
    assert request("failover", AT) != request("failover", AT + 1e-5)


@pytest.mark.parametrize(
    "text",
    [
        "failover 2026-11-22T14:02:11Z",
        "failover 2026-11-22T14:02:11,123456789+00:00",  # date -Ins
        "  failover   2026-11-22T15:02:11+01:00 ",
    ],
)
def test_times_in_formats_of_other_programs_are_read(text: str) -> None:
    assert round(parse(text).at) == 1795356131


@pytest.mark.parametrize("text", ["", "failover", "fence 2026-11-22T14:02:11Z", "failover tomorrow", "failover 1 2"])
def test_an_invalid_request_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match='write failover or failback and the current time, such as "failover 20'):
        parse(text)
