"""The one error that a user is meant to read."""


class UserError(Exception):
    """Input that the user can correct; the command line prints it as one line and exits with 2.

    The message says what was given, where, and what would be valid.
    """
