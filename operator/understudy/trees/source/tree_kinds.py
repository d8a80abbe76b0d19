"""The kinds of trees, as messages name them: health trees, procedures and checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TreeKind:
    """A kind of tree."""

    one: str
    """Such as ``health tree``."""
    named: bool
    """Whether the names of its nodes say something; in others they are for people alone."""

    @property
    def a(self) -> str:
        """Such as ``a health tree``."""
        return f"a {self.one}"

    @property
    def many(self) -> str:
        """Such as ``health trees``."""
        return f"{self.one}s"


HEALTH = TreeKind("health tree", named=True)
PROCEDURE = TreeKind("procedure", named=False)
CHECK = TreeKind("check", named=False)
