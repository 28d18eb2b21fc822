"""The one error that a user is meant to read, and how its message ends where a name is unknown."""

from __future__ import annotations

import difflib
from collections.abc import Collection


class UserError(Exception):
    """Input that the user can correct; the command line prints it as one line and exits with 2.

    The message says what was given, where, and what would be valid.
    """


def closest(name: str, valid: Collection[str]) -> str | None:
    """The valid name that was probably meant; None where none is close."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1)), None)


def nearest(name: str, valid: Collection[str]) -> str:
    """The end of an error message: what was meant, perhaps, and what would be valid."""
    meant = closest(name, valid)
    hint = f"did you mean {meant!r}? " if meant else ""
    return f"{hint}valid: {', '.join(valid) or 'none'}"


def nearest_first(name: str, valid: Collection[str]) -> str:
    """The end of an error message: what would be valid, the likeliest first."""
    near = difflib.get_close_matches(name, list(valid), n=len(valid) or 1, cutoff=0.5)
    return f"valid: {', '.join([*near, *(other for other in valid if other not in near)])}"
