"""UserError: the one exception that is shown to users as a message. Importing it loads nothing else."""


class UserError(Exception):
    """A mistake that the user can correct: shown as one message, without a traceback, with exit code 1.

    ``key`` is the setting that is wrong, if the message has no example of a right one. The command line then
    adds the value of the YAML files.
    """

    def __init__(self, message: str, *, key: str = "") -> None:
        super().__init__(message)
        self.key = key
