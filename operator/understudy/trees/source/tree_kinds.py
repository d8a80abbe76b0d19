"""The kinds of trees, as messages name them: health trees, procedures and checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TreeKind:
    """A kind of tree."""

    one: str
    """In singular, such as ``health tree``."""
    named: bool
    """Whether the names of its nodes have a meaning; in other kinds they are only for readers."""

    @property
    def a(self) -> str:
        """With its article, such as ``a health tree``."""
        return f"a {self.one}"

    @property
    def many(self) -> str:
        """In plural, such as ``health trees``."""
        return f"{self.one}s"


HEALTH = TreeKind("health tree", named=True)
PROCEDURE = TreeKind("procedure", named=False)
CHECK = TreeKind("check", named=False)
