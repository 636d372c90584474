"""Mistakes of a user: the command line shows their message and no traceback."""


class InputError(ValueError):
    """A study, a file or an argument that cannot be used; the message says where, what was expected and what to do."""
