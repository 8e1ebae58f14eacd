"""UserError: the one exception that is shown to users as a message. Importing it loads nothing else."""


class UserError(Exception):
    """A mistake that the user can correct: shown as one message, without a traceback, with exit code 1."""
