"""Generated objects are the same for the same seed, and no function of operator or monitor ends with an error of its own for them."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.fuzz import trees
from bench.fuzz.samples import sample
from bench.fuzz.unaided import tried
from understudy.trees.languages.notations import FORMS, load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.problems import TreeError


def test_an_object_is_repeated_from_its_seed() -> None:
    assert sample(11) == sample(11)
    assert len({sample(number).text for number in range(5)}) == 5


@pytest.mark.parametrize("seed", [506, 563, 1022, *range(20)])
def test_operator_and_monitor_take_or_refuse_an_object(seed: int) -> None:
    faults = [fault for fault in tried(sample(seed)).faults if "processor time" not in fault]
    assert not faults, f"scripts/bench fuzz --unaided --only {seed}"


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_texts_of_all_languages_are_taken_or_refused(data: st.DataObject) -> None:
    form = data.draw(st.sampled_from([form for form in FORMS if form != "yaml"]))
    health, procedure = data.draw(trees.texts(form, trees.health)), data.draw(trees.texts(form, trees.procedures))
    for load in (lambda: load_health(form, health, grace=1.0), lambda: compose(form, procedure, check=False, path="p")):
        with contextlib.suppress(TreeError):
            load()
