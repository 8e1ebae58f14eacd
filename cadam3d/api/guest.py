"""Guest: run a command inside somebody else's program, and leave that program as it was.

The command line owns its process; a library does not. Everything of the process that training changes is
restored here: torch's modes, and where messages go. What an error suggests to type is Python here.
"""

import json
import re
import shlex
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cadam3d.commands.beginning import messages
from cadam3d.commands.messages import note
from cadam3d.core.checks import fail
from cadam3d.core.console import heard_by
from cadam3d.core.errors import UserError
from cadam3d.settings.compose import quote, value_of
from cadam3d.settings.line import QUOTED, key_of

HINT = "Try: "
# A word of a command line that sets something, or that names a folder of YAML files.
WORD = re.compile(r"\+?[a-z][\w./@]*=.*|~[a-z][\w./@=]*", re.DOTALL)
FLAG = "--config-dir"
# The functions that do what a command does, and the setting that is their first argument.
FUNCTIONS = {"train": ("train", "prompt"), "sweep": ("sweep", ""), "eval": ("evaluate", "run")}
# Hydra has one configuration per process, so that threads take turns.
_turn = threading.RLock()


@contextmanager
def as_guest() -> Iterator[None]:
    """Run the block with the state that cadam3d expects of its process, and restore the process afterwards.

    Messages go to the logger ``cadam3d.messages``. Only one thread at a time is in such a block.
    """
    # Each call says what the user must know about it, even if an earlier one has said the same.
    note.cache_clear()
    with _turn, hinting(), logging_messages(), usual_modes():
        yield


@contextmanager
def hinting(*, has_words: bool = True) -> Iterator[None]:
    """Suggest Python in the errors of the block, where they suggest a line or words for a shell.

    ``has_words`` says that the function takes words of the command line, and not an argument per setting.
    """
    try:
        yield
    except UserError as error:
        text, mark, hint = str(error).rpartition(HINT)
        raise UserError(f"{text}{mark}{in_python(hint, has_words=has_words)}") from error.__cause__


def in_python(hint: str, *, has_words: bool = True) -> str:
    """Return what to type in Python instead of words or a line for a shell. Other hints do not change."""
    try:
        words = shlex.split(hint)
    except ValueError:  # prose with an apostrophe
        return hint
    if words[:1] == ["cadam3d"]:
        return _call(*words[1:]) or f"in a shell: {hint}"
    if not words or not all(map(WORD.fullmatch, words)):
        return hint
    return ", ".join(_string(word) if has_words else _argument(word) for word in words)


def _call(command: str, *words: str) -> str:
    """Return the call that does what a line does; empty if there is none, as for a page of help."""
    function, key = FUNCTIONS.get(command, ("", ""))
    is_plain = all(WORD.fullmatch(word) or FLAG in (word, before) for before, word in pairwise(("", *words)))
    if not function or not is_plain:
        return ""
    first = [_string(word.partition("=")[2]) for word in words if key_of(word) == key]
    if function == "train" and not first:
        first = ["None" if any(key_of(word) == "resume" for word in words) else "..."]
    rest = [_string(word) for word in words if key_of(word) != key]
    return f"cadam3d.{function}({', '.join([*first, *rest])})"


def _argument(word: str) -> str:
    """Return a word as an argument with a name. A run is the first argument of what reads it."""
    key, _, text = word.partition("=")
    return _string(text) if key == "run" else f"{key.rpartition('.')[2]}={value_of(word)!r}"


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


@contextmanager
def logging_messages() -> Iterator[None]:
    """Pass messages on to the logger ``cadam3d.messages`` while the block runs."""
    with heard_by(lambda text, level: messages.log(level, "%s", text.strip())):
        yield


@contextmanager
def usual_modes() -> Iterator[None]:
    """Run the block with the modes of torch that a new process has, whatever the caller has chosen.

    These are float32 and the CPU as defaults, exact products of matrices, gradients, and no autocast.
    """
    dtype, precision = torch.get_default_dtype(), torch.get_float32_matmul_precision()
    # The context of a device slows every call of torch a little, so it is entered only where it is needed.
    device = nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")
    with ExitStack() as stack:
        stack.callback(torch.set_default_dtype, dtype)
        torch.set_default_dtype(torch.float32)
        # Writing this setting touches several backends, so it is written only where it differs.
        if precision != "highest":
            stack.callback(torch.set_float32_matmul_precision, precision)
            torch.set_float32_matmul_precision("highest")
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        stack.enter_context(device)
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        yield


def literal(key: str, text: str) -> str:
    """Return the word of a command line that sets ``key`` to exactly ``text``, whatever it contains."""
    is_plain = not QUOTED.fullmatch(text) and "${" not in text and text.lower() != "null"
    return f"{key}={text if is_plain else quote(text)}"


def require_free(overrides: tuple[str, ...], taken: Mapping[str, object]) -> None:
    """Raise ``UserError`` for an override of a key in ``taken``, which an argument sets already."""
    for override in overrides:
        if (key := key_of(override)) in taken:
            got = f"the argument {taken[key]!r} and {override!r}"
            raise fail(key, expected="one value", got=got, example="the argument alone")


def stop_signals() -> tuple[int, ...]:
    """Return the signals after which a long work saves: Ctrl-C, which only the main thread receives."""
    return (signal.SIGINT,) if threading.current_thread() is threading.main_thread() else ()


def plain(value: Any) -> Any:
    """Return ``value`` with numbers and arrays of NumPy and torch as Python's own."""
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic | Tensor) else value
