"""What docs/trees.md shows is so."""

import re
from pathlib import Path

import pytest
import yaml

from understudy.trees.loading import TreeError, load

PAGE = (Path(__file__).parents[3] / "docs" / "trees.md").read_text()


def test_the_example_loads_and_its_leaves_are_called_as_it_says():
    example, *_ = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    tree = load(yaml.safe_load(example))
    leaves = [node.name for node in tree.root.iterate() if not node.children]
    assert leaves == ["cmd_vel", "sensors/scan", "sensors/odom"]


def test_the_mistakes_are_named_as_it_says():
    (shown,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    tree = {"parallel": [{"topic": {"name": "/cmd_vel", "gap": 500}}, {"paralel": []}]}
    with pytest.raises(TreeError) as caught:
        load(tree)
    assert [str(problem) for problem in caught.value.problems] == shown.splitlines()
