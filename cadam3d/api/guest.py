"""Guest: run a command inside somebody else's program, and leave that program as it was.

The command line owns its process; a library does not. Everything of the process that training changes is
restored here: Hydra's global state, torch's modes, logging, and where messages go.
"""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch

from cadam3d.commands.messages import note
from cadam3d.core.checks import fail
from cadam3d.core.console import heard_by
from cadam3d.settings.compose import quote
from cadam3d.settings.hydra import keeping_globals
from cadam3d.settings.line import QUOTED

log = logging.getLogger("cadam3d")
# The messages that the command line prints. They are not part of train.log.
messages = logging.getLogger("cadam3d.messages")
# As Hydra writes train.log.
LOG_LINE = "[%(asctime)s][%(name)s][%(levelname)s] - %(message)s"
# Hydra has one configuration per process, so that threads take turns.
_turn = threading.RLock()


@contextmanager
def as_guest() -> Iterator[None]:
    """Run the block with the state that cadam3d expects of its process, and restore the process afterwards.

    Messages go to the logger ``cadam3d.messages``. Only one thread at a time is in such a block.
    """
    with _turn, keeping_globals(), logging_messages(), usual_modes():
        yield


@contextmanager
def logging_messages() -> Iterator[None]:
    """Pass messages on to the logger ``cadam3d.messages`` while the block runs."""
    # Each call says what the user must know about it, even if an earlier one has said the same.
    note.cache_clear()
    with heard_by(_pass_on):
        yield


@contextmanager
def usual_modes() -> Iterator[None]:
    """Run the block with gradients, float32 and the CPU as defaults, whatever the caller has chosen."""
    dtype = torch.get_default_dtype()
    # The context of a device slows every call of torch a little, so it is entered only where it is needed.
    device = nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")
    torch.set_default_dtype(torch.float32)
    try:
        with device, torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(dtype)


@contextmanager
def logged_to(path: Path) -> Iterator[None]:
    """Write what cadam3d logs into ``path``, from the level INFO on, while the block runs.

    The handlers of the caller get no record that they would not get otherwise.
    """
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter(LOG_LINE))
    file.addFilter(lambda record: record.name != messages.name)
    onward = _Onward(log.getEffectiveLevel())
    level, is_propagating = log.level, log.propagate
    log.addHandler(file)
    if is_propagating:
        log.addHandler(onward)
    log.setLevel(min(logging.INFO, onward.level))
    log.propagate = False
    try:
        yield
    finally:
        log.setLevel(level)
        log.propagate = is_propagating
        log.removeHandler(onward)
        log.removeHandler(file)
        file.close()


class _Onward(logging.Handler):
    """Passes records on to the handlers of the root, as propagation does, but not those of lower levels."""

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one record on."""
        logging.getLogger().callHandlers(record)


def _pass_on(text: str, level: int) -> None:
    messages.log(level, "%s", text.strip())


def literal(key: str, text: str) -> str:
    """Return the word of a command line that sets ``key`` to exactly ``text``, whatever it contains."""
    is_plain = not QUOTED.fullmatch(text) and "${" not in text
    return f"{key}={text if is_plain else quote(text)}"


def require_object(key: str, value: object, kind: type, example: str) -> None:
    """Raise ``UserError`` unless ``value`` is an object of class ``kind``."""
    if not isinstance(value, kind):
        expected = f"an object of class {kind.__module__}.{kind.__name__}"
        raise fail(key, expected=expected, got=value, example=example)


def require_words(overrides: tuple[Any, ...]) -> None:
    """Raise ``UserError`` unless every override is a text."""
    for override in overrides:
        require_object("overrides", override, str, '"steps=600"')
