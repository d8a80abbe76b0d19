"""Checks that a pod template has the right types, in the fields that the operator reads.

The API server stores the template of a RobotWorkload or FallbackPool without a check, and validates only the pods that
are created from it. Until then, a list may be a string, and a string may be a number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_LISTS = ("containers", "initContainers", "volumes", "tolerations", "imagePullSecrets", "topologySpreadConstraints")
_CONTAINER_LISTS = ("env", "ports", "volumeMounts", "volumeDevices")
_PREFERRED = "preferredDuringSchedulingIgnoredDuringExecution"


def problem(template: Mapping[str, Any], path: str) -> str | None:
    """Return the first field under ``path`` that has the wrong type, as a problem; None if there is none."""
    return next(_problems(template.get("spec") or {}, f"{path}.spec"), None)


def _problems(spec: Mapping[str, Any], at: str) -> Iterator[str]:
    for key in _LISTS:
        yield from _objects(spec.get(key), f"{at}.{key}")
    for key in ("containers", "initContainers"):
        for index, container in enumerate(spec.get(key) or []):
            yield from _container(container, f"{at}.{key}[{index}]")
    yield from _object(spec.get("affinity"), f"{at}.affinity")
    apart = (spec.get("affinity") or {}).get("podAntiAffinity")
    yield from _object(apart, f"{at}.affinity.podAntiAffinity")
    yield from _objects((apart or {}).get(_PREFERRED), f"{at}.affinity.podAntiAffinity.{_PREFERRED}")


def _container(container: Mapping[str, Any], at: str) -> Iterator[str]:
    yield from _text(container.get("name"), f"{at}.name")
    for key in _CONTAINER_LISTS:
        yield from _objects(container.get(key), f"{at}.{key}")
    for key in ("command", "args"):
        yield from _list(container.get(key), f"{at}.{key}")
        for index, part in enumerate(container.get(key) or []):
            yield from _text(part, f"{at}.{key}[{index}]")
    for index, entry in enumerate(container.get("env") or []):
        yield from _text(entry.get("name"), f"{at}.env[{index}].name")
        if entry.get("value") is not None:  # without a value, it is empty
            yield from _text(entry["value"], f"{at}.env[{index}].value")
    yield from _object(container.get("lifecycle"), f"{at}.lifecycle")


def _objects(found: Any, at: str) -> Iterator[str]:
    yield from _list(found, at)
    for index, item in enumerate(found or []):
        if not isinstance(item, dict):
            yield f"{at}[{index}] must be an object, but is {_shown(item)}"


def _list(found: Any, at: str) -> Iterator[str]:
    if found is not None and not isinstance(found, list):
        yield f"{at} must be a list, but is {_shown(found)}"


def _object(found: Any, at: str) -> Iterator[str]:
    if found is not None and not isinstance(found, dict):
        yield f"{at} must be an object, but is {_shown(found)}"


def _text(found: Any, at: str) -> Iterator[str]:
    if not isinstance(found, str):
        advice = ": put it in quotes" if isinstance(found, int | float) else ""
        yield f"{at} must be a string, but is {_shown(found)}{advice}"


def _shown(found: Any) -> str:
    match found:
        case None:
            return "missing"
        case dict():
            return "an object"
        case list():
            return "a list"
        case bool():
            return str(found).lower()
        case str():
            return "a string"
    return str(found)
