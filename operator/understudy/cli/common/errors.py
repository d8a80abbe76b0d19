"""Errors that end a verb with a message and exit status 2."""

from __future__ import annotations


class CommandError(Exception):
    """The command cannot be carried out. The message says what was found and what to do."""


class Forbidden(CommandError):
    """The user does not have the permission."""
