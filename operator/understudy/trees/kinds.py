"""The kinds of leaves by their keys in the short form, but for the one that only counts messages."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees import vocabulary
from understudy.trees.added import added
from understudy.trees.ages import AGE
from understudy.trees.diagnostics import DIAGNOSTICS
from understudy.trees.lifecycles import LIFECYCLE
from understudy.trees.logs import LOG
from understudy.trees.motions import MOTION
from understudy.trees.nodes import NODE
from understudy.trees.parameters import PARAMETER
from understudy.trees.plans import LeafKind
from understudy.trees.pods import POD_LEAF
from understudy.trees.progress import PROGRESS
from understudy.trees.publishers import PUBLISHER
from understudy.trees.transforms import TRANSFORM
from understudy.trees.values import VALUE

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

TAKEN = frozenset((*vocabulary.STEPS, *vocabulary.LOOKS, *_WORDS.split()))
"""What has two words or more in one of the languages already; one word alone no leaf of others can be called."""

_ADDED = added(TAKEN)

ADDED: Mapping[str, LeafKind] = _ADDED.leaves
"""Those of other installed packages."""

UNUSABLE: Mapping[str, str] = _ADDED.refused
"""Why others of such packages can't be used."""

LEAVES: Mapping[str, LeafKind] = {**_OWN, **ADDED}
"""All of them."""
