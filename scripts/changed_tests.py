"""Print the test files that belong to the changes since a commit, for ``make check``.

A changed module selects the test files that import it directly, and the folder of tests that mirrors its
package. A changed option of the configuration selects the tests of its group and ``tests/test_configs.py``, a
changed page selects the tests of the documentation, and a changed test file selects itself. The rules about
imports and prose are always checked.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parent.parent
ALWAYS = ("tests/test_architecture.py", "tests/test_prose.py")


def main() -> None:
    """Read the base commit from the command line and print the test files on one line."""
    base = sys.argv[1] if len(sys.argv) > 1 else "main"
    changed = changed_files(base)
    print(" ".join(tests_of(changed)) if changed else "")


def changed_files(base: str) -> list[str]:
    """Return the paths that differ from the merge base with ``base``, uncommitted and new files included."""
    merge_base = git("merge-base", base, "HEAD") or [base]
    new = git("ls-files", "--others", "--exclude-standard")
    return sorted({*git("diff", "--name-only", merge_base[0]), *new})


def tests_of(changed: list[str]) -> list[str]:
    """Return the test files for the changed paths, in order and each once."""
    files = sorted((REPOSITORY / "tests").rglob("test_*.py"))
    imports = {path: set(imported_modules(path)) for path in files}
    selected = {REPOSITORY / name for name in ALWAYS}
    for name in changed:
        path = Path(name)
        match path.parts[0]:
            case "cadam3d" if path.suffix == ".py":
                module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
                selected |= {test for test, modules in imports.items() if module in modules}
                selected |= mirror(path.parts[1:])
            case "cadam3d":
                selected |= mirror(path.parts[1:])
            case "configs":
                selected |= {REPOSITORY / "tests" / "test_configs.py", *mirror(path.parts[1:])}
            case "tests" if path.name.startswith("test_"):
                selected.add(REPOSITORY / path)
            case "tests":
                selected |= set((REPOSITORY / path).parent.glob("test_*.py"))
            case "scripts":
                selected |= set((REPOSITORY / "tests").rglob(f"test_{path.stem}.py"))
            case "docs":
                selected |= {REPOSITORY / "tests" / name for name in ("test_docs.py", "test_extending.py")}
            case "pyproject.toml" | "Makefile" | "constraints.txt":
                selected.add(REPOSITORY / "tests" / "test_packaging.py")
            case _ if path.suffix == ".md":
                selected.add(REPOSITORY / "tests" / "test_docs.py")
    return sorted(str(path.relative_to(REPOSITORY)) for path in selected if path.is_file())


def mirror(parts: tuple[str, ...]) -> set[Path]:
    """Return the test files that mirror a path of the package or of the configuration."""
    if len(parts) > 1:
        return set((REPOSITORY / "tests" / parts[0]).glob("test_*.py"))
    return {REPOSITORY / "tests" / f"test_{Path(parts[0]).stem}.py"}


def imported_modules(path: Path) -> Iterator[str]:
    """Yield the modules of cadam3d that a file imports; ``from a import b`` may name the module ``a.b``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def git(*words: str) -> list[str]:
    """Return the lines that git prints; an empty list if it fails, for example without such a branch."""
    done = subprocess.run(["git", *words], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return done.stdout.split("\n")[:-1] if done.returncode == 0 else []


if __name__ == "__main__":
    main()
