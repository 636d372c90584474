"""User errors, which the command line reports without traceback."""


class InputError(ValueError):
    """An invalid study, file or argument; the message says where, what was expected and what to do."""
