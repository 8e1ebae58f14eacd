"""UserError lives apart from the checks that raise it, so that the command line can name it without torch."""


class UserError(Exception):
    """A mistake the user can mend: shown as one message, without a traceback, with exit code 1."""
