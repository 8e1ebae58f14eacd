"""The results of a run: one JSON file, from which a run continues and which is shown as Markdown."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

PASSED, FAILED, SKIPPED, ENDED = "passed", "FAILED", "skipped", "ended by its time limit"


@dataclass(frozen=True)
class Entry:
    """The outcome of one piece."""

    part: str
    status: str
    says: str  # one line
    seconds: float
    date: str
    is_gate: bool = False  # whether times need it to pass
    command: str = ""
    result: dict[str, Any] | None = None


@dataclass
class Record:
    """Everything that a run has found, in the order in which it was found."""

    machine: dict[str, Any]
    # A hash of all that a result depends on. With another one, results are measured again.
    state: str
    pieces: dict[str, Entry] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write the record in one step, so that the file is whole at any time."""
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".part")
        unfinished.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")
        unfinished.replace(path)

    def passed(self, name: str) -> bool:
        """Return whether a piece has passed."""
        return name in self.pieces and self.pieces[name].status == PASSED


def read_record(path: Path) -> Record:
    """Return the record in a file. Raises ``ValueError`` if the file is not a record."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        pieces = {name: Entry(**entry) for name, entry in data["pieces"].items()}
        return Record(data["machine"], data["state"], pieces)
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"{path} is not a record of this script ({type(error).__name__}: {error}). "
            f"Try: mv {path} {path}.old"
        ) from error
