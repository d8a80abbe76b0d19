"""What the API server says of a template, and what it says of something else."""

from __future__ import annotations

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.controller.reconcile.template_validation import Judge
from understudy.kube.client import ApiError, Object

POD: Object = {"metadata": {"name": "w-check", "namespace": "fleet", "labels": {names.TEMPLATE_HASH: "abc"}}}


def refusing(words: str) -> MemoryClient:
    client = MemoryClient()
    client.failing = lambda method, name: ApiError(403, "Forbidden", f'pods "{name}" is forbidden: {words}')
    return client


async def test_an_exceeded_quota_is_not_a_problem_of_the_template() -> None:
    # Else a namespace whose quota is just right would be left as it is by each new leader.
    client = refusing("exceeded quota: fleet, requested: pods=1, used: pods=9, limited: pods=9")
    assert await Judge(client).judge(POD, "spec.template") is None


@pytest.mark.parametrize(
    "words",
    [
        "failed quota: fleet: must specify limits.cpu for: app",
        'violates PodSecurity "restricted:latest"',
        "no admission",
    ],
)
async def test_a_refusal_because_of_the_template_is_reported(words: str) -> None:
    found = await Judge(refusing(words)).judge(POD, "spec.template")
    assert found is not None
    assert found.reason == "TemplateInvalid"
    assert words in found.message


async def test_a_server_that_has_not_loaded_its_roles_yet_does_not_judge_a_template() -> None:
    client = MemoryClient()
    client.failing = lambda method, name: ApiError(403, "Forbidden", "cannot create resource pods", just_back=True)
    judge = Judge(client)
    with pytest.raises(ApiError):
        await judge.judge(POD, "spec.template")
    client.failing = lambda method, name: None
    assert await judge.judge(POD, "spec.template") is None
