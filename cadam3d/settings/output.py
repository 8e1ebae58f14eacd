"""Output: which exporter writes the file that ``output=NAME.SUFFIX`` names."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from cadam3d.core.checks import fail
from cadam3d.exporter.base import Exporter, exporters_by_suffix
from cadam3d.io.run_folder import expanded, numbered, setting_word
from cadam3d.settings.compose import value_of
from cadam3d.settings.line import is_list, key_of, text_of
from cadam3d.settings.options import option_class, option_names

GROUP = "exporter"
# What render writes of several runs, if the line names no exporter: one picture and one video.
COMPARING = ("preview", "turntable")
# What to type for files that only another program writes.
INSTEAD: dict[str, str] = dict.fromkeys((".blend", ".dae", ".fbx", ".usd", ".usdz"), "for=blender")


def exporting(overrides: Sequence[str], folders: Sequence[Path] = ()) -> list[str]:
    """Choose the exporter for a file that ``output=`` names by its suffix.

    ``folders`` have the YAML files of the line, by default the package's. A line does not change if it
    names no file, or if it chooses the exporter in another way: with ``for=``, with ``exporter=``, or by
    setting an exporter that writes no such file. Raises ``UserError`` if no exporter writes such a file.
    """
    given = {key_of(override): override for override in overrides}
    name = text_of(given["output"]) if "output" in given else ""
    named = {key.split(".")[1] for key in given if key.startswith("exporter.")}
    # A setting of an exporter, such as exporter.glb.up=-y, is a deliberate change of what for= chooses.
    if "for" in given and "exporter" in given:
        raise fail("exporter", expected="for= alone", got=given["exporter"], example=given["for"])
    if "for" in given or not names_file(name):
        is_comparison = is_list(given.get("run", "")) and "exporter" not in given and named <= set(COMPARING)
        return [*overrides, *([f"exporter=[{','.join(COMPARING)}]"] if is_comparison else [])]
    classes = exporter_classes(folders)
    by_suffix = exporters_by_suffix(classes)
    suffix = suffix_of(name, by_suffix)
    if suffix not in by_suffix and not named and "exporter" not in given:
        expected = f"a file with suffix {'|'.join(by_suffix)}, or a folder"
        free = setting_word("output", f"{numbered(Path(name), first=1)}/")
        raise fail("output", expected=expected, got=name, example=INSTEAD.get(suffix, free))
    if "exporter" in given:
        value = value_of(given["exporter"])
        named |= set(map(str, value if isinstance(value, list) else [value]))
    chosen = next((each for each in by_suffix.get(suffix, []) if named <= {each}), None)
    if chosen is None or given.get("exporter", "").endswith("=[]"):
        return list(overrides)
    words = [] if "exporter" in given else [f"exporter=[{chosen}]"]
    setting = classes[chosen].suffix_setting
    if setting and (key := f"exporter.{chosen}.{setting}") not in given:
        words.append(f"{key}={suffix.removeprefix('.')}")
    return [*overrides, *words]


def exporter_classes(folders: Sequence[Path]) -> dict[str, type[Exporter]]:
    """Return the class of every option of the group ``exporter``, by its name."""
    classes = {name: option_class(GROUP, name, folders) for name in option_names(GROUP, folders)}
    return {name: found for name, found in classes.items() if found is not None}


def names_file(name: str) -> bool:
    """Return whether a value of ``output=`` names a file: it has a suffix and is not a folder that exists."""
    # Unlike Path.is_dir, this accepts a name that is too long, which is refused later by its key.
    return bool(Path(name).suffix) and not name.endswith("/") and not os.path.isdir(expanded(name))  # noqa: PTH112


def suffix_of(name: str, known: Mapping[str, object]) -> str:
    """Return the suffix of a file in lower case: the longest one in ``known``, or else the last one."""
    name = Path(name).name.lower()
    found = [suffix for suffix in known if name.endswith(suffix) and name != suffix]
    return max(found, key=len, default=Path(name).suffix)
