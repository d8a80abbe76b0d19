"""An operator of named namespaces has no right to list namespaces; it watches its own from the start."""

from __future__ import annotations

import asyncio
import ssl

import pytest

from tests.support.nested_values import Answers, api_server, list_of, text
from tests.unit.controller import world
from understudy.controller.runtime import kopf_handlers
from understudy.kube.client import POLICIES, Access, Object, Resource


async def test_the_watches_by_kopf_do_not_wait_for_a_list_of_namespaces(caplog: pytest.LogCaptureFixture) -> None:
    answers, seen = Answers(), asyncio.Event()
    answers.forbidden.add("/api/v1/namespaces")
    answers.lists[POLICIES.plural] = list_of("FailurePolicy", [text(world.policy("Restart"), 0)])

    def see(resource: Resource, item: Object, gone: bool) -> None:
        seen.set()

    async with api_server(answers) as url:
        access = Access(server=url, context=ssl.create_default_context())
        watching = asyncio.create_task(kopf_handlers.watch(see, access, [world.NAMESPACE]))
        try:
            async with asyncio.timeout(10):
                await seen.wait()
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
    assert "Request attempt" not in caplog.text
