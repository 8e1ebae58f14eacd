"""Count the code by room: lines, nodes of the syntax tree without docstrings, and the length of functions.

    python scripts/count_size.py              # a table in Markdown, as in docs/architecture.md
    python scripts/count_size.py ../other     # of another checkout

A room is a folder of the package. The modules beside the folders are two rooms: the shell (``cli``,
``launch`` and their neighbours) and the rest. Nodes are counted too, because longer lines do not make fewer
nodes.
"""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

SHELL = ("cli", "launch", "job", "__main__")
BODIES = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class Size:
    """The size of some modules."""

    lines: int = 0
    nodes: int = 0
    functions: list[int] = field(default_factory=list)  # lines of each

    def add(self, path: Path) -> None:
        """Count one module."""
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        self.lines += len(text.splitlines())
        for node in ast.walk(tree):
            self.nodes += 1
            # A docstring is an expression and a constant.
            if isinstance(node, BODIES) and ast.get_docstring(node, clean=False) is not None:
                self.nodes -= 2
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                self.functions.append(node.end_lineno - node.lineno + 1)

    def row(self, name: str) -> str:
        """Return a row of the table."""
        length = f"{median(self.functions):.0f}" if self.functions else ""
        return f"| {name} | {self.lines:,} | {self.nodes:,} | {length} |"


def room_of(path: Path) -> str:
    """Return the room of a module, given its path inside the package."""
    if len(path.parts) > 1:
        return f"`{path.parts[0]}`"
    return "`cli`, `launch`" if path.stem in SHELL else "other modules"


def rows(checkout: Path) -> Iterator[str]:
    """Yield the rows of the table: rooms by size, then the sums."""
    rooms: dict[str, Size] = defaultdict(Size)
    totals: dict[str, Size] = defaultdict(Size)
    for folder in ("cadam3d", "tests", "scripts"):
        for path in sorted((checkout / folder).rglob("*.py")):
            totals[folder].add(path)
            if folder == "cadam3d":
                rooms[room_of(path.relative_to(checkout / folder))].add(path)
    for name, size in sorted(rooms.items(), key=lambda item: -item[1].nodes):
        yield size.row(name)
    for folder, size in totals.items():
        yield size.row(f"**all of `{folder}`**")


def main() -> None:
    """Print the table."""
    checkout = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1]
    print("| room | lines | nodes | median function, lines |\n|---|---:|---:|---:|")
    print("\n".join(rows(checkout)))


if __name__ == "__main__":
    main()
