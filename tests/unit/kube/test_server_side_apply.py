"""Differences are what must be written; others' objects are left alone."""

from __future__ import annotations

import json
from typing import Any

import pytest
import yaml

from tests.unit.kube.memory import MemoryClient
from understudy.kube import apply
from understudy.kube.client import SECRETS, Object, encoded


@pytest.mark.parametrize(
    ("live", "desired", "found"),
    [
        ({"a": 1, "default": 2}, {"a": 1}, []),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1}}, []),
        ({"a": {"b": 1}}, {"a": {"b": 2}}, [".a.b"]),
        ({}, {"a": {"b": 2}}, [".a"]),
        ({"a": [{"n": 1, "d": 0}]}, {"a": [{"n": 1}]}, []),
        ({"a": [1, 2]}, {"a": [1]}, [".a"]),
        ({"a": [1]}, {"a": [2]}, [".a[0]"]),
        ({}, {"a": "", "b": [], "c": {}}, []),
        ({"a": "x"}, {"a": ""}, [".a"]),
        ({"a": [1]}, {"a": []}, [".a"]),
    ],
)
def test_desired_fields_that_differ_are_listed(live: Any, desired: Any, found: list[str]) -> None:
    assert apply.differences(live, desired) == found


def test_a_changed_stamp_shows_that_a_field_was_withdrawn() -> None:
    with_both = apply.stamped({"metadata": {"name": "x"}, "spec": {"a": 1, "b": 2}})
    with_one = apply.stamped({"metadata": {"name": "x"}, "spec": {"a": 1}})
    assert apply.differences(with_both, with_one) == [f".metadata.annotations.{apply.APPLIED}"]


def owned(uid: str) -> Object:
    owner = {
        "apiVersion": "understudy.dev/v1alpha1",
        "kind": "RobotWorkload",
        "name": "w",
        "uid": uid,
        "controller": True,
    }
    return {"kind": "Secret", "metadata": {"name": "w-agent", "ownerReferences": [owner]}}


async def test_creating_an_object_twice_returns_the_first_one() -> None:
    client = MemoryClient()
    first = await apply.create(client, SECRETS, "fleet", owned("u1"))
    second = await apply.create(client, SECRETS, "fleet", owned("u1"))
    assert first["metadata"]["uid"] == second["metadata"]["uid"]


@pytest.mark.parametrize("foreign", [owned("u2"), {"kind": "Secret", "metadata": {"name": "w-agent"}}])
async def test_an_object_of_another_owner_is_unchanged_and_reported(foreign: Object) -> None:
    client = MemoryClient()
    await client.create(SECRETS, "fleet", foreign)
    before = dict(client.items)
    with pytest.raises(apply.OwnedByOther, match=r'Secret "w-agent" exists in namespace fleet'):
        await apply.create(client, SECRETS, "fleet", owned("u1"))
    assert client.items == before


EVERY_KIND = "\U0001f6a7 \x7f \x80 \x85 \x9f \xa0 \u2028 \ufeff \ufffe \uffff \\ \\ud83d\\udea7 \x00\x1b \" ' \t\r\n"


def test_the_body_of_an_apply_is_yaml_whatever_characters_its_texts_have() -> None:
    """The API server answered 400 for an emoji in a text that a condition quotes, again and again."""
    body = {EVERY_KIND: [EVERY_KIND, {"a": EVERY_KIND}]}
    sent = encoded(body)
    assert yaml.load(sent, yaml.CSafeLoader) == json.loads(sent) == body


def test_half_a_character_is_replaced_in_the_body_of_a_request() -> None:
    assert json.loads(encoded({"a": "\ud83d!"})) == {"a": "\ufffd!"}
