"""What is left of an object for a definition that doesn't know all of it."""

from __future__ import annotations

import pytest

from understudy.kube.client import Object
from understudy.kube.undeclared_fields import without

BODY: Object = {
    "status": {
        "health": "Healthy",
        "gate": {"epoch": 1, "key": "x"},
        "recoveries": [{"id": "a"}, {"id": "b", "why": "z"}],
        "conditions": [{"type": "A", "since": 1}, {"type": "B", "since": 2}],
    }
}


@pytest.mark.parametrize(
    ("field", "left"),
    [
        (".status.gate", {key: value for key, value in BODY["status"].items() if key != "gate"}),
        (".status.gate.key", BODY["status"] | {"gate": {"epoch": 1}}),
        (".status.recoveries[1].why", BODY["status"] | {"recoveries": [{"id": "a"}, {"id": "b"}]}),
        (
            '.status.conditions[type="B"].since',
            BODY["status"] | {"conditions": [{"type": "A", "since": 1}, {"type": "B"}]},
        ),
        ('.status.conditions[type="C"].since', BODY["status"]),
        (".status.recoveries[7].why", BODY["status"]),
        (".status.none.of.these", BODY["status"]),
    ],
)
def test_a_field_that_the_api_server_reports_as_undeclared_is_removed(field: str, left: Object) -> None:
    assert without(BODY, [field]) == {"status": left}
    assert BODY["status"]["gate"] == {"epoch": 1, "key": "x"}, "the object itself stays as it is"
