"""The kinds of leaves that look into messages, by their keys in the short form."""

from __future__ import annotations

from understudy.trees.ages import AGE
from understudy.trees.diagnostics import DIAGNOSTICS
from understudy.trees.plans import LeafKind
from understudy.trees.transforms import TRANSFORM
from understudy.trees.values import VALUE

LEAVES: dict[str, LeafKind] = {"value": VALUE, "age": AGE, "diagnostics": DIAGNOSTICS, "transform": TRANSFORM}
