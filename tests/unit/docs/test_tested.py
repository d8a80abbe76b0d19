"""The page of what is tested on pods has every feature of the code, and marks of tests name nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.generation import tested

REPOSITORY = Path(__file__).resolve().parents[3]


def write(root: Path, text: str) -> None:
    (root / tested.TESTS).mkdir(parents=True)
    (root / tested.TESTS / "test_one.py").write_text(f"import pytest\n\n\n{text}")


def test_marks_of_end_to_end_tests_name_features() -> None:
    found = tested.shown(REPOSITORY)
    assert {"leaf/topic", "gate/Mux", "readiness/Executing"} <= {feature for feature, tests in found.items() if tests}


def test_a_mark_that_names_no_feature_is_an_error(tmp_path: Path) -> None:
    write(tmp_path, '@pytest.mark.shows("leaf/topic", "leaf/tpoic")\ndef test_it() -> None: ...\n')
    with pytest.raises(ValueError, match=r"test_one\.py, test_it: leaf/tpoic is no feature; there are leaf/topic, "):
        tested.page(tmp_path)


def test_a_feature_has_its_tests_or_none(tmp_path: Path) -> None:
    write(
        tmp_path,
        '@pytest.mark.long\n@pytest.mark.shows("gate/Mux", "step/publish")\ndef test_it() -> None: ...\n'
        '\n\n@pytest.mark.shows("gate/Mux")\ndef test_more() -> None: ...\n',
    )
    lines = tested.page(tmp_path).splitlines()
    file = "../../tests/e2e/test_one.py"
    assert f"| gate | `Mux` | [test_it]({file}), [test_more]({file}) |" in lines
    assert f"| step | `publish` | [test_it]({file}) |" in lines
    assert "| leaf | `age` | **none** |" in lines
    assert any(line.startswith(f"2 of {len(tested.features())} features") for line in lines)


@pytest.mark.parametrize(
    "feature",
    ["leaf/motion", "step/set_lifecycle", "condition/lifecycle_is", "language/osc", "strategy/Auto", "handover/BreakBeforeMake",
     "readiness/Uninitialized", "output/topic", "output/service", "output/action", "gate/NetworkPolicy"],
)  # fmt: skip
def test_features_are_those_of_the_code(feature: str) -> None:
    assert feature in tested.features()
    assert len(set(tested.features())) == len(tested.features())
