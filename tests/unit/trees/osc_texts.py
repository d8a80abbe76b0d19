"""Trees in OpenSCENARIO 2 for tests."""

from __future__ import annotations

from functools import partial

import pytest

from understudy.trees.languages.notations import load_health
from understudy.trees.source.problems import TreeError

load_osc = partial(load_health, "osc", grace=30.0)

LEAF = 'topic("/scan", gap: 1s)'


def scenario(*lines: str, parameters: str = "") -> str:
    """A file of a scenario with a parallel, of which the first node is in line 4, column 9; parameters are in lines before."""
    inside = "\n".join(f"        {line}" for line in lines)
    given_ = "".join(f"    {line}\n" for line in parameters.splitlines())
    return f"import osc.understudy\nscenario healthy:\n{given_}    do parallel:\n{inside}\n"


def problems(text: object) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load_osc(text)
    return [str(problem).removeprefix("spec.monitoring.osc, ") for problem in caught.value.problems]
