"""One error tree. Every message says what went wrong, where, and what to do about it."""


class RtError(Exception):
    """Base of all errors this project raises on purpose; an entry point prints it as one line."""

    exit_code = 1


class UsageError(RtError):
    """The command line or a configuration file asks for something that cannot be."""


class SetupError(RtError):
    """The machine lacks something the run needs: a bus, a binary, room on the disk."""
