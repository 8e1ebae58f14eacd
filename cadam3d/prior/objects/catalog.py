"""Catalog: the objects of a folder of meshes, and which of them a prompt names."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, StringConstraints, TypeAdapter, ValidationError

from cadam3d.core.checks import fail, nearest
from cadam3d.core.console import visible
from cadam3d.core.mesh.textured import MESH_SUFFIXES, TexturedMesh
from cadam3d.io.reading import read_text
from cadam3d.io.run_folder import expanded, has_file
from cadam3d.prior.exact import Census, stored_census
from cadam3d.prior.objects.scene import MeshScene, read_object
from cadam3d.prior.shapes.grammar import SIMILAR
from cadam3d.prior.shapes.words import ARTICLES, FILLERS, typed_words

WORLD = Path(__file__).parent / "world"  # the objects that come with cadam3d
CATALOG = "catalog.json"
KEY = "prior.folder"
LARGEST_CATALOG = 1 << 24  # bytes
MOST_FILES = 100_000  # of all kinds in a folder and its subfolders
MOST_MODES = 8  # objects of one prompt
CENSUS_OBJECTS = 32  # of a folder, evenly spaced
# The parts of a file name that are words: "deckChair_02" has "deck" and "Chair".
NAME_PART = re.compile(r"[^\W\d_]?[^\W\d_A-Z]+|[A-Z]+(?![a-z])")


def _one_line(text: str) -> str:
    if visible(text) != text or "\n" in text:
        raise ValueError("control characters")
    return text


# Names and credits are shown in messages.
Line = Annotated[str, StringConstraints(max_length=200), AfterValidator(_one_line)]


class Entry(BaseModel):
    """One object of a folder."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: Line = ""
    file: str  # within the folder
    name: Line
    tags: tuple[Line, ...] = ()
    licence: Line = ""
    author: Line = ""
    up: Literal["-y", "+y", "+z"] = "+y"  # the up axis of the file

    @property
    def words(self) -> frozenset[str]:
        """Return the words of the name and of the tags, in lower case."""
        return frozenset(_words(" ".join([self.name, *self.tags])))

    @property
    def credit(self) -> str:
        """Return the name with its author and licence, as far as they are known."""
        return " ".join([self.name, *([f"by {self.author}"] * bool(self.author)), self.licence]).strip()


@dataclass(frozen=True)
class Catalog:
    """The objects of a folder, in the order of its catalogue or of their file names."""

    folder: Path
    entries: tuple[Entry, ...]

    def matching(self, prompt: str) -> list[Entry]:
        """Return the objects that a prompt names: those with this name, else those with all of its words."""
        asked = _asked(prompt)
        named = [entry for entry in self.entries if asked and _asked(entry.name) == asked]
        return named or [entry for entry in self.entries if asked and entry.words.issuperset(asked)]

    def nearest(self, prompt: str) -> str:
        """Return the words of an object's name that are nearly the prompt or a word of it; "" if none."""
        asked = _asked(prompt)
        names = [" ".join(_words(entry.name)) for entry in self.entries]
        near = (nearest(text, names, least=SIMILAR) for text in (" ".join(asked), *asked))
        return next(filter(None, near), "")

    def scene(self, entries: Sequence[Entry]) -> MeshScene:
        """Return the scene whose modes are these objects. Raises ``UserError`` if one cannot be read."""
        return MeshScene([self._mesh(entry) for entry in entries], self.census)

    def census(self, size: int) -> Census:
        """Return the census over a sample of the objects; it is kept as long as their files do not change."""
        sample = _spread(self.entries, CENSUS_OBJECTS)
        states = [(self.folder / entry.file).stat() for entry in sample]
        facts = [
            (entry.file, entry.up, state.st_size, state.st_mtime_ns)
            for entry, state in zip(sample, states, strict=True)
        ]
        return _census(self, size, f"objects {self.folder.resolve()} {facts}")

    def _mesh(self, entry: Entry) -> TexturedMesh:
        return read_object(str(self.folder / entry.file), KEY, entry.up)


@lru_cache(maxsize=4)
def _census(catalog: Catalog, size: int, identity: str) -> Census:
    scenes = (catalog.scene([entry]) for entry in _spread(catalog.entries, CENSUS_OBJECTS))
    return stored_census(identity, scenes, size)


@lru_cache(maxsize=4)
def read_catalog(folder: str | None) -> Catalog:
    """Return the objects of the folder in ``prior.folder``; None means those that come with cadam3d.

    Raises ``UserError`` if there are none, and for files or links that lead out of the folder.
    """
    place = WORLD if folder is None else expanded(folder)
    entries = _listed(place) if has_file(place, CATALOG) else tuple(_found(place))
    inside = place.resolve() if entries else place
    for entry in entries:
        file = place / entry.file
        if not has_file(file) or not file.resolve().is_relative_to(inside):
            raise fail(KEY, expected="files that exist and are within the folder", got=entry.file)
    if not entries:
        expected = f"a folder with meshes ({', '.join(MESH_SUFFIXES)}) or a {CATALOG}"
        raise fail(KEY, expected=expected, got=str(folder), example=f"{KEY}=DIR")
    return Catalog(place, entries)


def modes(entries: Sequence[Entry]) -> list[Entry]:
    """Return the objects that become modes: all of them, or a sample if there are many."""
    return _spread(entries, MOST_MODES)


def _listed(folder: Path) -> tuple[Entry, ...]:
    """Return the entries of the catalogue of a folder."""
    try:
        text = read_text(folder / CATALOG, largest=LARGEST_CATALOG)
        return TypeAdapter(tuple[Entry, ...]).validate_json(text)
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(map(str, problem["loc"]))
        expected = f"a {CATALOG} with a file and a name for each object"
        raise fail(KEY, expected=expected, got=f"{place}: {problem['msg']}", example=f"{KEY}=DIR") from error


def _found(folder: Path) -> Iterator[Entry]:
    """Return an entry for each mesh in a folder and its subfolders; file names count as names."""
    files: list[Path] = []
    # A name that no folder can have is an OSError.
    with suppress(OSError):
        files = list(islice(folder.rglob("*"), MOST_FILES + 1)) if folder.is_dir() else []
    if len(files) > MOST_FILES:
        raise fail(KEY, expected=f"a folder with at most {MOST_FILES:,} files", got=str(folder))
    for file in sorted(files):
        # macOS and editors add hidden files with the same endings.
        if file.suffix.lower() in MESH_SUFFIXES and file.is_file() and not file.name.startswith("."):
            name = " ".join(NAME_PART.findall(file.stem)).lower() or file.stem
            try:
                yield Entry(file=file.relative_to(folder).as_posix(), name=name)
            except ValidationError as error:
                expected = "file names without control characters"
                raise fail(KEY, expected=expected, got=file.name) from error


def _asked(text: str) -> list[str]:
    """Return the words of a prompt or of a name without those that say nothing, unless it has no others."""
    words = [word for word in _words(text) if word not in ARTICLES]
    return [word for word in words if word not in FILLERS] or words


def _words(text: str) -> list[str]:
    return [word.lower() for word in typed_words(text)]


def _spread(entries: Sequence[Entry], most: int) -> list[Entry]:
    """Return at most ``most`` entries, evenly spaced."""
    step = max(1.0, len(entries) / most)
    return [entries[int(number * step)] for number in range(min(most, len(entries)))]
