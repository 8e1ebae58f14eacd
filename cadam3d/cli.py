"""The command line: the first word is the command, and Hydra reads the rest of the line.

Nothing heavy is imported before it is needed, so that help and the completion of the command are instant.
"""

import contextlib
import gc
import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence

from cadam3d import __version__
from cadam3d.core.console import complain, say, show
from cadam3d.core.errors import UserError
from cadam3d.core.openmp import waiting

COMMANDS = {  # the purpose of each, and a line to paste
    "train": ("optimise an asset for a prompt", 'cadam3d train prompt="a red torus"'),
    "sweep": ("train many times, one table of results", 'cadam3d sweep prompt="a red torus" grid=densifiers'),
    "render": ("make pictures or a turntable of an asset", "cadam3d render run=outputs/latest"),
    "export": ("write an asset for other programs", "cadam3d export run=outputs/latest"),
    "eval": ("measure a finished run or sweep", "cadam3d eval run=outputs/latest"),
    "view": ("show a run in a browser, also while it trains", "cadam3d view run=outputs/latest"),
    "study": ("let people compare runs, and evaluate it", "cadam3d study runs=multirun/thresholds"),
    "doctor": ("check this machine, with a hint per failure", "cadam3d doctor"),
}
HELP = """\
cadam3d {version}: a sentence in, 3D Gaussians out

Usage: cadam3d COMMAND [key=value ...]

{commands}

Settings of a command:  cadam3d COMMAND --help
Settings of an option:  cadam3d train --help densifier=cadam
Tab completion (bash):  eval "$(cadam3d -sc install=bash)\""""
HELP_FLAGS = ("--help", "-h", "help")
COMPLETION_FLAGS = ("--shell-completion", "-sc")
# Libraries that print their messages in their own way, and read their level from NAME_VERBOSITY.
TALKATIVE = ("TRANSFORMERS", "DIFFUSERS", "HF_HUB")


def main() -> None:
    """Run the command line of this process and exit: 0 for success, 1 for an error, 130 for an interrupt."""
    wants_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ.update(waiting(os.environ))
    _hush_libraries()
    # Python processes that this one starts, such as the workers of a launcher, would import modules from the
    # current folder, where a file may be called yaml.py.
    os.environ["PYTHONSAFEPATH"] = "1"
    # Imports create many objects but no garbage. Searching for it would take a fifth of the start-up time.
    gc.disable()
    try:
        code = dispatch(sys.argv[1:])
        sys.stdout.flush()
    except UserError as error:
        if wants_traceback:
            raise
        complain(str(error))
        code = 1
    except KeyboardInterrupt:
        say("")
        complain("interrupted")
        code = 130
    except BrokenPipeError:
        # A reader such as head has closed the pipe. Python would complain when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)


def _hush_libraries() -> None:
    """Hide the warnings of other libraries, which address programmers. PYTHONWARNINGS shows them."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        os.environ.update({f"{name}_VERBOSITY": "error" for name in TALKATIVE} | os.environ)


def dispatch(words: Sequence[str]) -> int:
    """Run the command line ``words``, without the program's name, and return the exit code."""
    if not words or words[0] in HELP_FLAGS:
        commands = [f"  {name:<8}{summary:<50}{example}" for name, (summary, example) in COMMANDS.items()]
        show(HELP.format(version=__version__, commands="\n".join(commands)))
        return 0
    if words[0] == "--version":
        show(f"cadam3d {__version__}")
        return 0
    if words[0] in COMPLETION_FLAGS:
        return complete(words)
    if words[0] not in COMMANDS:
        from cadam3d.core.checks import fail, nearest

        example = f"cadam3d {nearest(words[0], COMMANDS) or '--help'}"
        raise fail("command", expected=f"one of {'|'.join(COMMANDS)}", got=words[0], example=example)
    from cadam3d.launch import launch

    return launch(words[0], words[1:])


def complete(words: Sequence[str]) -> int:
    """Print tab completions. The command is completed here, and Hydra completes the words after it.

    ``-sc install=SHELL`` prints a script for the shell. The script calls ``-sc query=SHELL`` with the line so
    far in ``COMP_LINE``.
    """
    action, _, shell = "".join(words[1:2]).partition("=")
    if action not in ("install", "uninstall", "query") or shell not in ("bash", "zsh", "fish"):
        from cadam3d.core.checks import fail

        example = 'eval "$(cadam3d -sc install=bash)"'
        raise fail("-sc", expected="install=bash|zsh|fish", got=words[1:], example=example)
    if action == "query":
        line = os.environ.get("COMP_LINE", "")
        try:
            typed = shlex.split(line)[1:]
        except ValueError:  # a quote is still open
            typed = line.split()[1:]
        is_new_word = line.endswith(" ")
        if not typed or (len(typed) == 1 and not is_new_word):
            start = typed[0] if typed else ""
            separator = "\n" if shell == "fish" else " "
            show(separator.join(name for name in COMMANDS if name.startswith(start)))
            return 0
        if typed[0] not in COMMANDS:
            return 0
        # Hydra splits the line at blanks and reads every word, so leave out sentences and half-typed quotes.
        *done, last = [*typed[1:], ""] if is_new_word else typed[1:]
        plain = [word for word in done if " " not in word and not word.startswith(("prompt=", "negative_"))]
        os.environ["COMP_LINE"] = " ".join(["cadam3d", *plain, last])
    from cadam3d.settings.compose import run_hydra

    command = typed[0] if action == "query" else "train"
    # A line that is wrong so far has no completions.
    with contextlib.suppress(Exception):
        run_hydra(command, words)
    return 0
