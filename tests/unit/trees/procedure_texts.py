"""Procedures in three languages for tests."""

from __future__ import annotations

import pytest

from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.problems import TreeError

PATH = "bringUp"


def file(*lines: str) -> str:
    """A file of one tree, which begins in line 3."""
    inside = "\n".join(lines)
    return f'<root BTCPP_format="4">\n<BehaviorTree ID="Main">\n{inside}\n</BehaviorTree>\n</root>'


def scenario(*lines: str) -> str:
    """A file of a scenario, of which the first node is in line 4, column 9."""
    inside = "\n".join(f"        {line}" for line in lines)
    return f"import osc.understudy\nscenario main:\n    do serial:\n{inside}\n"


def problems(form: str, text: object, *, check: bool = False) -> list[str]:
    with pytest.raises(TreeError) as caught:
        compose(form, text, check=check, path=PATH)
    return [str(problem).removeprefix(f"{PATH}, ") for problem in caught.value.problems]


ACTIVE = {"set_lifecycle": {"node": "/amcl", "state": "active"}}


ACTIVE_XML = '<SetLifecycle node="/amcl" state="active"/>'


ACTIVE_OSC = 'set_lifecycle("/amcl", lifecycle_state!active)'
