"""UserError: separate from the checks that raise it, so that the command line imports it without torch."""


class UserError(Exception):
    """A mistake that the user can correct: shown as one message, without a traceback, with exit code 1."""
