"""What is said where a command can't be carried out as asked for."""

from __future__ import annotations


class Unusable(Exception):
    """Something that was given can't be used; the text says what was found and what would be right."""
