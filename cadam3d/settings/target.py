"""Target: refuse a line of ``cadam3d export`` if its ``for=`` cannot be fulfilled."""

from collections.abc import Sequence

from cadam3d.core.errors import UserError
from cadam3d.exporter.programs import PROGRAMS, UNKNOWN
from cadam3d.settings.advice import line_of
from cadam3d.settings.line import key_of, text_of

TARGET = "for"


def require_target(overrides: Sequence[str]) -> None:
    """Raise ``UserError`` if a line asks for a program with unknown axes, or also names an exporter.

    A program decides which exporter is right, so the line must not name another one. A setting of that
    exporter, such as ``exporter.glb.up=-y``, is a deliberate change and stays.
    """
    given = {key_of(override): override for override in overrides}
    if TARGET not in given:
        return
    target = text_of(given[TARGET])
    if target in UNKNOWN:
        known = "|".join(sorted(program.target for program in PROGRAMS))
        rest = [word for word in overrides if key_of(word) != TARGET and not is_export(word)]
        line = line_of("export", [*rest, *UNKNOWN[target].words])
        raise UserError(
            f"{TARGET}: expected a program whose axes are known ({known}), got {target!r}: "
            f"{UNKNOWN[target].reason}. Try: {line}"
        )
    if "exporter" in given:
        line = line_of("export", [word for word in overrides if key_of(word) != "exporter"])
        raise UserError(
            f"exporter: expected {TARGET}={target} alone, which chooses the exporter, got both. Try: {line}"
        )


def is_export(word: str) -> bool:
    """Return whether a word chooses or sets an exporter, or names the file that is written."""
    return key_of(word).partition(".")[0] in ("exporter", "output")
