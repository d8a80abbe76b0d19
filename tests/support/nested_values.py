"""Values nested so deeply that neither :mod:`json` nor :mod:`copy` can process them, and a server that sends them.

Kubernetes' own decoder reads up to 10,000 levels.
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any

from aiohttp import web

from tests.support.http_server import serving

DEPTHS = (150, 350, 700, 1_000, 1_500, 9_000)
"""Python's functions end at different depths: some at 250 levels, json at 1,000, and at more in later versions of Python."""

PLACE = "the nested value stands here"


def nested(levels: int) -> str:
    """Return the text of mappings and lists in turn, as JSON."""
    return '{"a":[' * (levels // 2) + "]}" * (levels // 2)


def text(item: Mapping[str, Any], levels: int) -> str:
    """Return an object as JSON, with a nested value at each place where it has PLACE."""
    return json.dumps(item, separators=(",", ":")).replace(f'"{PLACE}"', nested(levels))


def list_of(kind: str, items: Iterable[str]) -> str:
    """Return a list of custom objects, as the API server writes it."""
    head = f'{{"apiVersion":"understudy.dev/v1alpha1","items":[{",".join(items)}],'
    return head + f'"kind":"{kind}List","metadata":{{"continue":"","resourceVersion":"50"}}}}'


KINDS = {
    "/api/v1": {"namespaces": "Namespace"},
    "/apis/apiextensions.k8s.io/v1": {"customresourcedefinitions": "CustomResourceDefinition"},
    "/apis/understudy.dev/v1alpha1": {
        "failurepolicies": "FailurePolicy",
        "fallbackpools": "FallbackPool",
        "robotworkloads": "RobotWorkload",
    },
}
"""The kinds that the server has, by the path of their group."""


class Answers:
    """The lists and watches of an API server, by the plural of the resource. What is absent is empty."""

    def __init__(self) -> None:
        self.lists: dict[str, str] = {}
        self.events: dict[str, list[str]] = {}
        self.forbidden: set[str] = set()
        """The paths that the operator may not ask for."""

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer one request."""
        plural = request.path.rpartition("/")[2]
        if request.path == "/api":
            return web.json_response({"versions": ["v1"]})
        if request.path == "/apis":
            return web.json_response({"groups": [_group(path) for path in KINDS if path != "/api/v1"]})
        if request.path in KINDS:
            return web.json_response({"resources": [_resource(*kind) for kind in KINDS[request.path].items()]})
        if request.path in self.forbidden:
            return web.json_response({"kind": "Status", "status": "Failure", "code": 403}, status=403)
        if "watch" not in request.query:
            return web.Response(text=self.lists.get(plural, list_of("", ())), content_type="application/json")
        response = web.StreamResponse(headers={"Content-Type": "application/json"})
        await response.prepare(request)
        for event in self.events.get(plural, ()):
            half = len(event) // 2  # a line arrives in pieces
            await response.write(event[:half].encode())
            await response.write(event[half:].encode() + b"\n")
        return response


def _group(path: str) -> dict[str, Any]:
    group, version = path.removeprefix("/apis/").split("/")
    entry = {"groupVersion": f"{group}/{version}", "version": version}
    return {"name": group, "versions": [entry], "preferredVersion": entry}


def _resource(plural: str, kind: str) -> dict[str, Any]:
    verbs = ["get", "list", "watch", "patch"]
    return {"name": plural, "singularName": "", "kind": kind, "namespaced": True, "verbs": verbs}


@asynccontextmanager
async def api_server(answers: Answers) -> AsyncIterator[str]:
    """Serve these answers, and yield the URL."""
    app = web.Application()
    app.router.add_route("*", "/{path:.*}", answers.answer)
    async with serving(app, shutdown_timeout=0.1) as url:
        yield url
