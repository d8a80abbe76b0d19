"""Trees in BehaviorTree.CPP for tests."""

from __future__ import annotations

from functools import partial

import pytest

from understudy.trees.languages.notations import load_health
from understudy.trees.source.problems import TreeError

load_xml = partial(load_health, "xml", grace=30.0)

LEAF = '<Topic topic="/scan" gap="1s"/>'


def files(main: str, **others: str) -> str:
    """A file of several trees: the main one is in line 2, each of the others in the next one."""
    trees = "\n".join(
        f'<BehaviorTree ID="{name}">{tree}</BehaviorTree>' for name, tree in {"Main": main, **others}.items()
    )
    return f'<root BTCPP_format="4" main_tree_to_execute="Main">\n{trees}\n</root>'


def problems(text: object) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load_xml(text)
    return [str(problem).removeprefix("spec.monitoring.xml, ") for problem in caught.value.problems]


SCAN_XML = '<Topic topic="/scan" gap="1s"/>'


ODOM_XML = '<Topic topic="/odom" rate="9 to 11 Hz" window="3s" type="nav_msgs/msg/Odometry"/>'


BOTH = SCAN_XML + ODOM_XML
