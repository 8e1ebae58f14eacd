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
TESTS = REPOSITORY / "tests"
ALWAYS = ("test_architecture.py", "test_prose.py")  # rules that any change can break


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
    selected = {TESTS / name for name in ALWAYS}
    for name in changed:
        selected |= tests_of_path(Path(name))
    return sorted(str(path.relative_to(REPOSITORY)) for path in selected if path.is_file())


def tests_of_path(path: Path) -> set[Path]:
    """Return the test files for one changed path; some may not exist."""
    selected: set[Path] = set()
    match path.parts[0]:
        case "cadam3d":
            selected = importers(path) | mirror(path.parts[1:])
        case "configs":
            selected = {TESTS / "test_configs.py", *mirror(path.parts[1:])}
        case "tests" if path.name.startswith("test_"):
            selected = {REPOSITORY / path}
        case "tests" | "scripts":  # a helper of the tests beside it, or a script with a test of its own
            names = (path.stem, path.parent.name)
            selected = {test for name in names for test in TESTS.rglob(f"test_{name}.py")}
            selected |= set((REPOSITORY / path).parent.glob("test_*.py"))
            if path.parts[0] == "scripts":
                selected |= importers_of_script(path)
        case "pyproject.toml" | "Makefile" | "constraints.txt":
            selected = {TESTS / "test_packaging.py"}
        case "mkdocs.yml" | "CITATION.cff":
            selected = {TESTS / "test_site.py"}
        case _ if path.suffix == ".md":
            selected = {TESTS / f"test_{name}.py" for name in ("docs", "extending", "site")}
    return selected


def importers(path: Path) -> set[Path]:
    """Return the test files that import a module of the package directly."""
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    return {test for test in TESTS.rglob("test_*.py") if module in imported_modules(test)}


def importers_of_script(path: Path) -> set[Path]:
    """Return the test files that import a script, or any module of its folder."""
    name = Path(path.parts[1]).stem
    modules = {test: set(imported_modules(test)) for test in TESTS.rglob("test_*.py")}
    return {test for test, found in modules.items() if any(each.partition(".")[0] == name for each in found)}


def mirror(parts: tuple[str, ...]) -> set[Path]:
    """Return the test files that mirror a path of the package or of the configuration."""
    if len(parts) > 1:
        return set((TESTS / parts[0]).glob("test_*.py"))
    return {TESTS / f"test_{Path(parts[0]).stem}.py"}


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
