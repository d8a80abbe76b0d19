"""The kinds of leaves by their keys in the short form, but for the one that only counts messages."""

from __future__ import annotations

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

LEAVES: dict[str, LeafKind] = {
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
