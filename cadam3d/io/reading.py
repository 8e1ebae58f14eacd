"""Reading: open files that a stranger may have written, so that every problem is one message.

A file is read only if it is a regular file of a plausible size. A pipe or a device is refused, because
reading it could wait forever. YAML is read as plain data: without tags, without aliases (a few lines of which
can describe gigabytes), and with a limited depth.
"""

import os
import stat
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import yaml  # comes with OmegaConf

from cadam3d.core.errors import UserError

# Bytes. A configuration has some ten thousand; the table of a run of many hours has some ten million.
LARGEST_TEXT = 1 << 28
LARGEST_YAML = 1 << 22
DEEPEST = 64  # levels of YAML and JSON
BLANKS = "\n\t\r"  # the control characters that a text may have
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


# The loader in C is ten times as fast, but not every build of PyYAML has it.
_SAFE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _loader(is_used: Callable[[str], bool]) -> Any:
    """Return a loader of plain data, in which values without a used tag are text."""
    resolvers = {
        first: [(tag, pattern) for tag, pattern in found if is_used(tag.rpartition(":")[2])]
        for first, found in _SAFE.yaml_implicit_resolvers.items()
    }
    return type("Loader", (_SAFE,), {"yaml_implicit_resolvers": resolvers})


# A date stays text, as OmegaConf reads and writes it.
_Loader = _loader(lambda name: name != "timestamp")
_TextLoader = _loader(lambda name: name == "null")


def unusable(path: Path, problem: str) -> UserError:
    """Return the message about a file that cannot be used."""
    return UserError(f"{path}: {problem}. Try: another file")


def regular_descriptor(path: Path, flags: int, *, follows_links: bool = True) -> int:
    """Open a file with ``flags`` of ``os.open``, without waiting, and return its descriptor.

    Unless ``follows_links``, neither a link nor a file with a second name (a hard link) is opened.
    Raises ``UserError`` if ``path`` is not a regular file, and ``OSError`` if it cannot be opened (for a name
    with a null byte, ``ValueError``).
    """
    if not follows_links and path.is_symlink():
        raise unusable(path, "expected a file, got a link")
    # Without O_NONBLOCK, opening a named pipe waits for a writer.
    for name in ("O_NONBLOCK", "O_BINARY", "O_CLOEXEC", *(() if follows_links else ("O_NOFOLLOW",))):
        flags |= getattr(os, name, 0)
    descriptor = os.open(path, flags, 0o666)
    status = os.fstat(descriptor)
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG or not (follows_links or status.st_nlink <= 1):
        os.close(descriptor)
        got = "a hard link" if kind == stat.S_IFREG else KINDS.get(kind, "something else")
        raise unusable(path, f"expected a file, got {got}")
    return descriptor


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading bytes. Raises the exceptions of :func:`regular_descriptor`."""
    return os.fdopen(regular_descriptor(path, os.O_RDONLY), "rb")


def open_contained(folder: Path, name: str) -> BinaryIO:
    """Open the file ``name`` in ``folder`` for reading bytes, unless a link is on the way to it.

    ``name`` is a relative path that this package has chosen. Raises the exceptions of :func:`open_regular`.
    """
    path = folder
    for part in Path(name).parts:
        path /= part
        if path.is_symlink():
            raise unusable(path, "expected a file, got a link")
    return open_regular(path)


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file for reading bytes. Every failure of the system becomes one ``UserError``."""
    try:
        with open_regular(path) as file:
            yield file
    # A name with a null byte is a ValueError.
    except (OSError, ValueError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or error or "too large"
        raise unusable(path, f"cannot be read ({reason})") from error


def signature(file: BinaryIO) -> tuple[int, int, int, int]:
    """Return device, number, size (bytes) and time (ns) of an open file; a changed file differs in these."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def read_bytes(path: Path, *, largest: int) -> bytes:
    """Return the content of a regular file of at most ``largest`` bytes. Raises ``UserError`` on failure."""
    with opened(path) as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise unusable(path, f"expected at most {largest:,} bytes, got more")
    return content


def read_text(path: Path, *, largest: int = LARGEST_TEXT) -> str:
    """Return the content of a UTF-8 file of at most ``largest`` bytes. Raises ``UserError`` on failure."""
    try:
        return read_bytes(path, largest=largest).decode("utf-8")
    except UnicodeDecodeError as error:
        raise unusable(path, "expected UTF-8 text, got other bytes") from error


def read_yaml(path: Path) -> Any:
    """Return the plain data in a YAML file: dicts, lists, text, numbers, truth values and None.

    Raises ``UserError`` if the file cannot be read, or contains anything else.
    """
    text = read_text(path, largest=LARGEST_YAML)
    try:
        _require_plain(text)
        return yaml.load(text, _Loader)
    # A number with thousands of digits raises ValueError.
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise unusable(path, f"expected plain YAML, got {reason}") from error


def parse_text_yaml(text: str) -> Any:
    """Return the data of plain YAML, in which every value except null is text, as it is spelled.

    Raises ``ValueError`` for anything else.
    """
    try:
        _require_plain(text)
        return yaml.load(text, _TextLoader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def is_readable(text: str) -> bool:
    """Return whether a text can be written into a file and shown: Unicode without control characters."""
    return not any(unicodedata.category(each) in ("Cc", "Cs") and each not in BLANKS for each in text)


def _require_plain(text: str) -> None:
    """Raise ``ValueError`` for tags, aliases and too many levels, before anything is built."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        line = f"in line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"an alias, *{event.anchor}, {line}")
        # Even the tags of YAML itself make sets, tuples and dates, which are not plain data.
        if (tag := getattr(event, "tag", None)) is not None:
            raise ValueError(f"a tag, {tag}, {line}")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                raise ValueError(f"more than {DEEPEST} levels {line}")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
