"""Decoding leaves values as they are, down to the limit."""

from __future__ import annotations

import asyncio
import gc
import json
import random
from collections.abc import Callable

import pytest

from tests.support.nested_values import nested
from understudy.api.nesting import DEEPEST_OBJECT
from understudy.kube.decoding import LONG, bounded, decode, decode_each, decoded


@pytest.mark.parametrize(
    "text", ['{"a":"\\"[{","b":[[],{}," ]}"]}', "[]", "null", '"{"', "[1,[2.5,true]]", '["\\\\",[]]']
)
def test_brackets_in_strings_do_not_count(text: str) -> None:
    assert decode(text) == json.loads(text)
    many = f"[{','.join([text] * DEEPEST_OBJECT)}]"
    assert decode(many) == json.loads(many), "so many brackets that they are counted one by one"


def test_a_value_at_the_limit_is_kept_and_one_below_it_is_cut() -> None:
    assert decode(nested(DEEPEST_OBJECT)) == json.loads(nested(DEEPEST_OBJECT))
    wide = f'{{"a":{nested(DEEPEST_OBJECT + 2)},"b":{nested(4)}}}'
    found = decode(wide)
    assert found["b"] == json.loads(nested(4)), "what follows is kept"
    for _ in range(DEEPEST_OBJECT // 2):
        found = found["a"][0] if isinstance(found["a"], list) else found["a"]
    assert found == {"a": [None]} or found == {"a": None}


def drawn(choices: random.Random, depth: int) -> object:
    """Return a value of at most this depth, with brackets, quotes and backslashes in its strings."""
    kind = choices.random()
    if depth <= 0 or kind < 0.15:
        return choices.choice([1, 'a[{"', "\\", '\\\\"]', None, [], {}, [1, 2]])
    if kind < 0.6:
        return [drawn(choices, depth - 1) for _ in range(choices.choice([1, 1, 1, 2]))]
    return {choices.choice(['k"', "k\\", "["]): drawn(choices, depth - 1)}


def cut(value: object, depth: int = 1) -> object:
    """Return the value with None for all that is nested too deeply."""
    if not isinstance(value, dict | list):
        return value
    if depth > DEEPEST_OBJECT:
        return None
    if isinstance(value, dict):
        return {key: cut(inner, depth + 1) for key, inner in value.items()}
    return [cut(inner, depth + 1) for inner in value]


@pytest.mark.parametrize("depth", [0, *range(DEEPEST_OBJECT - 3, DEEPEST_OBJECT + 2)])
def test_only_what_is_too_deep_is_cut(depth: int) -> None:
    choices = random.Random(depth)
    for many in (1, 3, 30, 250):
        value: object = [drawn(choices, choices.randrange(8)) for _ in range(many)]
        for _ in range(depth):
            value = choices.choice([[value], {'b\\"': value}])
        text = json.dumps(value)
        assert decode(text) == cut(value)
        assert list(decode_each(f"{text} ,{text}")) == [cut(value)] * 2


def test_each_value_is_decoded_on_its_own() -> None:
    texts = ["1", nested(3_000), '{"b":[]}', nested(3_000), "[2]"]
    found = list(decode_each(" ,\n".join(texts)))
    assert (found[0], found[2], found[4]) == (1, {"b": []}, [2])
    assert found[1] == found[3] == decode(nested(3_000))


@pytest.mark.parametrize("text", ["[" * 5_000, "{" + "]" * 300, "", "[" * 300 + '"'])
def test_a_malformed_text_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match="line 1"):
        decode(text)


async def test_others_run_while_a_long_text_is_decoded() -> None:
    value = [[[]] * LONG]
    decoding = asyncio.create_task(decoded(json.dumps(value)))
    turns = 0
    while not decoding.done():
        await asyncio.sleep(0)
        turns += 1
    assert turns > 1, "it was not decoded in one turn of the event loop"
    assert await decoding == value
    assert await decoded("[1]") == [1]


async def texts_at_once(text: str) -> list[object]:
    return await asyncio.gather(*[decoded(text) for _ in range(3)])


@pytest.mark.parametrize(
    "read", [decode, bounded, lambda text: list(decode_each(text)), lambda text: asyncio.run(texts_at_once(text))]
)
def test_no_garbage_is_collected_while_a_long_text_is_decoded(read: Callable[[str], object]) -> None:
    """A collection visits all mappings and lists so far, again and again, and would keep the event loop busy."""
    text, begun = "[" + ",".join(["[0]"] * LONG) + "]", list[str]()

    def note(phase: str, info: dict[str, int]) -> None:
        begun.append(phase)

    gc.callbacks.append(note)
    try:
        found = read(text)
        during = len(begun)
    finally:
        gc.callbacks.remove(note)
    assert found
    assert gc.isenabled()
    assert during <= 6, "a collection before it and after it, each begun and ended; during it there would be hundreds"
