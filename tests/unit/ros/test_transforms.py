"""Real transforms on a shared topic keep only their own leaf healthy."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")
pytest.importorskip("tf2_msgs")

from tests.unit.ros.judged_tree import Judged, tell

pytestmark = pytest.mark.ros

TF = "tf2_msgs/msg/TFMessage"


def transform(parent: str, child: str, stamp: Any = "now") -> dict[str, Any]:
    return {"header": {"frame_id": parent, "stamp": stamp}, "child_frame_id": child}


def test_a_missing_transform_fails_although_others_arrive_on_the_topic(watching, processes, eventually):
    judged = Judged(watching, {"transform": {"parent": "odom", "child": "base_link", "gap": "2s"}})
    base, arm = (processes.node("say", "/tf", TF) for _ in range(2))
    tell(base, transforms=[transform("map", "odom"), transform("odom", "base_link")])
    tell(arm, transforms=[transform("base_link", "shoulder"), transform("shoulder", "elbow")])
    eventually(lambda: judged.now().state == "Healthy")
    tell(base, transforms=[transform("map", "odom")])
    verdict = judged.until_failed()
    assert verdict.reason == "no transform odom -> base_link on /tf for 2 s"
    before = watching.topic("/tf").count
    eventually(lambda: watching.drain() and watching.topic("/tf").count > before + 3)
    assert judged.now().state == "Failed", "the others are still there"
    tell(base, transforms=[transform("odom", "base_link")])
    eventually(lambda: judged.now().state == "Healthy")


def test_the_age_of_a_transform_is_measured_by_its_own_stamp(watching, processes, eventually):
    leaf = {"parent": "odom", "child": "base_link", "gap": "20s", "at_most": "20s"}
    judged = Judged(watching, {"transform": leaf})
    base, arm = (processes.node("say", "/tf", TF) for _ in range(2))
    old = {"sec": int(time.time()) - 3600, "nanosec": 0}
    tell(base, transforms=[transform("odom", "base_link")])
    eventually(lambda: judged.now().state == "Healthy")
    tell(arm, transforms=[transform("base_link", "shoulder", old)])
    eventually(lambda: _is_published(watching, "shoulder"))
    assert judged.now().state == "Healthy", "another's stamp is no matter"
    tell(base, transforms=[transform("odom", "base_link", old)])
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "20 s", "base_link", "/tf", "3.6e+03 s")
    tell(base, transforms=[transform("odom", "base_link")])
    eventually(lambda: judged.now().state == "Healthy")


def _is_published(watching: Any, child: str) -> bool:
    watching.drain()
    return any(content.mentions(child) for content in watching.topic("/tf").contents)
