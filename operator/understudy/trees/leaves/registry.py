"""The kinds of leaves by their keys in the short form, but for the one that only counts messages."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees.leaves import procedure_vocabulary
from understudy.trees.leaves.action_progress import PROGRESS
from understudy.trees.leaves.age import AGE
from understudy.trees.leaves.diagnostics import DIAGNOSTICS
from understudy.trees.leaves.leaf_plan import LeafKind
from understudy.trees.leaves.lifecycle import LIFECYCLE
from understudy.trees.leaves.log import LOG
from understudy.trees.leaves.motion import MOTION
from understudy.trees.leaves.node import NODE
from understudy.trees.leaves.parameter import PARAMETER
from understudy.trees.leaves.plugins import added
from understudy.trees.leaves.pod import POD_LEAF
from understudy.trees.leaves.publisher import PUBLISHER
from understudy.trees.leaves.transform import TRANSFORM
from understudy.trees.leaves.value import VALUE

_OWN: Mapping[str, LeafKind] = {
    "value": VALUE,
    "age": AGE,
    "diagnostics": DIAGNOSTICS,
    "transform": TRANSFORM,
    "publisher": PUBLISHER,
    "node": NODE,
    "log": LOG,
    "progress": PROGRESS,
    "lifecycle": LIFECYCLE,
    "motion": MOTION,
    "parameter": PARAMETER,
    "pod": POD_LEAF,
}

_WORDS = """
one_of remove_default associated_actor while_task_active sub_tree parallel_all reactive_sequence reactive_fallback
async_sequence async_fallback retry_until_successful
"""

TAKEN = frozenset((*procedure_vocabulary.STEPS, *procedure_vocabulary.LOOKS, *_WORDS.split()))
"""What has two words or more in one of the languages already; one word alone no leaf of others can be called."""

_ADDED = added(TAKEN)

ADDED: Mapping[str, LeafKind] = _ADDED.leaves
"""Those of other installed packages."""

UNUSABLE: Mapping[str, str] = _ADDED.refused
"""Why others of such packages can't be used."""

LEAVES: Mapping[str, LeafKind] = {**_OWN, **ADDED}
"""All of them."""
