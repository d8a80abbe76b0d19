"""Kept state survives the wire, and what is none is refused."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from understudy.api.protocol.agent_messages import MAX_LINE, ProtocolError, encode
from understudy.api.protocol.kept_state import (
    LARGEST,
    KeptSample,
    KeptState,
    LifecycleState,
    NotRestored,
    ParameterValues,
    Restored,
    RestoreReport,
)

POSE = KeptSample("/amcl_pose", "a/msg/Pose", 10.5, bytes(range(256)), "/initialpose", "now", "/amcl_pose")
MAP = KeptSample("/map", "n/msg/Map", 2.0, b"map")
PARAMETERS = ParameterValues("/controller", {"speed": 0.5, "count": 2, "names": ["a"], "on": True}, 3.0)
STATE = LifecycleState("/controller", "active", 4.0)
OLD = NotRestored("/plan", "too old", failed=False)
KEPT = KeptState((POSE, MAP), (PARAMETERS,), (STATE,), (OLD,))


def test_state_and_report_are_unchanged_by_encoding_and_decoding() -> None:
    assert KeptState.from_wire(json.loads(json.dumps(KEPT.to_wire()))) == KEPT
    report = RestoreReport((Restored("/amcl_pose", 10.5),), (OLD, NotRestored("/x", "no")))
    assert RestoreReport.from_wire(json.loads(json.dumps(report.to_wire()))) == report


def test_the_largest_message_fits_into_a_line() -> None:
    state = KeptState((KeptSample("/map", "n/msg/Map", 1.0, bytes(LARGEST), to="/map"),))
    assert len(encode({"id": 1, "op": "restore", "state": state.to_wire(), "within": 5.0})) <= MAX_LINE


@pytest.mark.parametrize(
    "wire",
    [
        {"samples": [{}]},
        {"samples": [{"topic": "/a", "type": "t", "takenAt": "x", "data": ""}]},
        {"samples": [{"topic": "/a", "type": "t", "takenAt": 1, "data": "%%"}]},
        {"parameters": [{"node": "/a", "values": 3, "takenAt": 1}]},
        {"lifecycle": 7},
    ],
)
def test_invalid_state_is_refused(wire: dict[str, object]) -> None:
    with pytest.raises(ProtocolError, match="not a kept"):
        KeptState.from_wire(wire)


def test_parameters_and_lifecycle_state_of_a_node_are_reported_separately() -> None:
    assert PARAMETERS.name != STATE.name
    assert RestoreReport((Restored(PARAMETERS.name, 1.0),)).merged(RestoreReport((Restored(STATE.name, 1.0),))) == (
        RestoreReport((Restored(PARAMETERS.name, 1.0), Restored(STATE.name, 1.0)))
    )


def test_state_is_selected_by_topic_restore_target_or_node() -> None:
    assert KEPT.only(["/amcl_pose"]).samples == KEPT.only(["/initialpose"]).samples == (POSE,)
    assert KEPT.only(["/controller"]) == KeptState((), (PARAMETERS,), (STATE,))
    assert KEPT.only(["/plan"]).left_out == (OLD,)
    assert KEPT.only([]) == KEPT


def test_only_changed_state_is_selected() -> None:
    contents = KEPT.contents() | {"/amcl_pose": b"elsewhere"}
    contents.pop(STATE.name)
    changed = KEPT.changed_from(contents)
    assert (changed.samples, changed.parameters, changed.lifecycle) == ((POSE,), (), (STATE,))
    assert not KEPT.changed_from(KEPT.contents())


def test_batches_contain_everything_once() -> None:
    big = [KeptSample(f"/t{i}", "t", 1.0, bytes(size), to="/x") for i, size in enumerate((40, 50, 60, 200, 10))]
    batches = KeptState(tuple(big), (PARAMETERS,), (STATE,), (OLD,)).batches(100)
    assert [[len(s.data) for s in batch.samples] for batch in batches] == [[40, 50], [60], [200], [10]]
    assert [bool(b.parameters or b.lifecycle or b.left_out) for b in batches] == [True, False, False, False]
    assert KeptState().batches(100) == [KeptState()]


def test_the_report_about_state_that_was_not_given_lists_all_of_it() -> None:
    report = KEPT.none_restored("gone")
    assert_golden("api", report.problem, "/amcl_pose", "/controller")
    assert OLD in report.not_restored


def test_the_last_result_of_a_repeated_restoration_counts() -> None:
    first = RestoreReport((), (NotRestored("/a", "no"), NotRestored("/b", "no")))
    assert first.merged(RestoreReport((Restored("/a", 1.0),))) == RestoreReport(
        (Restored("/a", 1.0),), (NotRestored("/b", "no"),)
    )
