"""Wandb: record a run for Weights & Biases, and send it there if an API key is configured.

Only what the functions below name leaves this machine: the settings in ``config.yaml``, the numbers and the
previews, the names of the run and of its sweep, and the versions of Python and of wandb. Everything that
wandb collects by itself is switched off: the console, code, git, the list of packages, the machine and its
load, the command line, and reports of errors. Without a key, nothing is sent.
"""

import os
import re
import secrets
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from cadam3d.callback.tracking import Tracking
from cadam3d.core.checks import one_of, within
from cadam3d.core.console import say
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import is_whole, read_json, write_json
from cadam3d.io.reading import read_yaml
from cadam3d.io.run_folder import CONFIG, WANDB, WANDB_RUN, shown, sweep_of
from cadam3d.state import RunContext

MODES = ("auto", "offline")
# The modes of wandb that send nothing; "disabled" records nothing either.
SILENT_MODES = ("offline", "dryrun", "disabled")
LONGEST_NAME = 128  # characters, of runs and groups
FLUSH_SECONDS = 5.0


@dataclass(kw_only=True)
class Wandb(Tracking):
    """Record the run in ``wandb/`` of its folder, and also on the server of Weights & Biases.

    A run keeps its id when it is resumed. The server accepts every step once and in order, so steps that were
    recorded before a run was killed are not recorded again. The jobs of a sweep form a group.
    """

    package: ClassVar[str] = "wandb"

    project: str
    entity: str | None  # a user or team of Weights & Biases
    mode: Annotated[str, one_of(MODES)]
    timeout: Annotated[float, within(low=1)]  # seconds
    _run: Any = field(default=None, init=False, repr=False)
    _file: Path = field(default=Path(), init=False, repr=False)
    _id: str = field(default="", init=False, repr=False)
    _recorded: int = field(default=0, init=False, repr=False)  # the last step

    def open(self, context: RunContext, step: int) -> None:
        """Start a run of wandb, or continue the folder's run: offline, unless a server accepts it."""
        # wandb reads this when it is imported. To send reports of its errors, set it to true beforehand.
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        self._file = context.folder / WANDB_RUN
        self._id, self._recorded = known_run(self._file)
        mode, reason = self._choose_mode(context.folder.resolve())
        self._run = self._start(context, mode)
        if mode == "online":
            # The server may have more steps than this disk knows of, or fewer.
            self._recorded = max(self._run.step - 1, 0)
        self._keep()
        if mode == "online":
            say(f"Weights & Biases: sending settings, numbers and previews to {self._run.url}")
        elif mode != "disabled":
            folder = shlex.quote(str(shown(context.folder / WANDB)))
            say(f"Weights & Biases: nothing is sent ({reason}). To send the run later: wandb sync {folder}")

    def record(self, step: int, numbers: Mapping[str, float], preview: Path | None) -> None:
        """Record one step, unless it is recorded already."""
        import wandb

        if step <= self._recorded:
            return
        picture = {} if preview is None else {"preview": wandb.Image(str(preview))}
        self._run.log({**numbers, **picture}, step=step)
        self._recorded = step
        self._keep()

    def conclude(self, context: RunContext, step: int, results: Mapping[str, float]) -> None:
        """Put the final numbers into the summary of the run."""
        self._run.summary.update(dict(results))

    def close(self, *, is_complete: bool) -> None:
        """Write and send what is left, for ``timeout`` seconds at most."""
        if self._run is not None:
            self._run.finish(exit_code=0 if is_complete else 1)
            self._remove_links()

    def _choose_mode(self, run: Path) -> tuple[str, str]:
        """Return the mode of wandb, and why nothing is sent."""
        if self.mode == "offline":
            return "offline", "callback.wandb.mode=offline"
        named = os.environ.get("WANDB_MODE")
        if named in SILENT_MODES:
            return named, f"WANDB_MODE={named}"
        if brings_settings(run):
            return "offline", "the folder of the run has settings of wandb, which could name another server"
        refusal = refused()
        return ("online", "") if refusal is None else ("offline", refusal)

    def _start(self, context: RunContext, mode: str) -> Any:
        import wandb

        sweep = sweep_of(context.folder.resolve())
        settings = wandb.Settings(
            mode=mode,  # pyright: ignore[reportArgumentType] (wandb checks it)
            project=self.project,
            entity=self.entity,
            run_id=self._id,
            run_name=context.folder.resolve().name[:LONGEST_NAME],
            run_group=None if sweep is None else sweep.name[:LONGEST_NAME],
            resume="allow",
            root_dir=str(context.folder.resolve()),
            # Do not end a run that another part of this process has started.
            reinit="create_new",
            init_timeout=self.timeout,
            finish_timeout=self.timeout,
            # Without this, a button on a page of the server would end the training.
            stop_fn=lambda: None,
            silent=True,
            symlink=False,
            console="off",
            disable_code=True,
            save_code=False,
            disable_git=True,
            x_save_requirements=False,
            x_disable_meta=True,
            x_disable_stats=True,
            x_disable_machine_info=True,
            x_transaction_log_flush_interval=FLUSH_SECONDS,
        )
        run = wandb.init(settings=settings, config=read_yaml(context.folder / CONFIG))
        self._remove_links()
        return run

    def _remove_links(self) -> None:
        """Remove wandb's link to a log in the user's cache, since no command accepts links out of a run."""
        for path in self._file.parent.glob("*/logs/*"):
            if path.is_symlink():
                path.unlink()

    def _keep(self) -> None:
        write_json(self._file, {"id": self._id, "recorded": self._recorded})


def known_run(path: Path) -> tuple[str, int]:
    """Return the id of a run of wandb and the last step that was recorded; a new id if there is none yet."""
    try:
        content = read_json(path)
        name, recorded = content["id"], content["recorded"]
        if re.fullmatch("[0-9a-f]{16}", name) and is_whole(recorded):
            return name, recorded
    except (UserError, LookupError, TypeError):
        pass
    return secrets.token_hex(8), 0


def brings_settings(run: Path) -> bool:
    """Return whether wandb would read settings from the folder of a run, or from its sweep's folder.

    wandb reads ``wandb/settings`` in the current folder, and sends the API key to the server that is named
    there. This program never writes that file, so it is of unknown origin.
    """
    here = Path.cwd()
    return here.is_relative_to(sweep_of(run) or run) and (here / WANDB / "settings").exists()


def refused() -> str | None:
    """Return why no server takes the run; None if there is an API key that a server has just accepted.

    The key may be in the environment, in ``.netrc`` or in the settings of wandb. The user is never asked.
    """
    import wandb
    from wandb.sdk.lib import wbauth

    host = wandb.setup().settings.base_url
    try:
        found = wbauth.authenticate_session(host=host, source="cadam3d", prompt=False, verify=True)
    except wandb.Error as error:
        return " ".join(str(error).split())[:200]
    return "there is no API key; wandb login stores one" if found is None else None
