"""Rules about the source code: floors, circles of imports, uses of Hydra, and sources of random numbers.

``docs/architecture.md`` explains the floors. Imports inside functions count like those at the top of a file.
"""

import ast
import builtins
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn
from omegaconf import DictConfig, ListConfig, OmegaConf

from cadam3d.io import run_folder

PACKAGE = Path(__file__).parent.parent / "cadam3d"
# The floor of each part of cadam3d. Parts of the same floor import each other only if SIDEWAYS lists that.
FLOORS = {
    "": -1.0,  # the version
    **dict.fromkeys(("core",), 0.0),
    **dict.fromkeys(("io",), 0.5),
    **dict.fromkeys(("compiled",), 0.6),
    **dict.fromkeys(("viewer",), 0.75),
    **dict.fromkeys(("camera", "background", "initializer", "rasterizer", "prior", "densifier"), 1.0),
    **dict.fromkeys(("augmentation", "optimizer", "exposure", "regularizer", "exporter", "metric"), 1.0),
    **dict.fromkeys(("plugins",), 1.5),
    **dict.fromkeys(("state", "callback", "guidance"), 2.0),
    **dict.fromkeys(("trainer",), 3.0),
    **dict.fromkeys(("settings",), 4.0),
    **dict.fromkeys(("build",), 4.5),
    **dict.fromkeys(("sweep",), 5.0),
    **dict.fromkeys(("report",), 6.0),
    **dict.fromkeys(("live", "study"), 6.5),
    **dict.fromkeys(("commands", "launch"), 7.0),
    **dict.fromkeys(("api",), 7.5),
    **dict.fromkeys(("cli", "__main__", "job"), 8.0),
}
# The lowest floor that may import Hydra and OmegaConf.
HYDRA_FLOOR = 4.0
SIDEWAYS = {("callback", "state"), ("launch", "commands"), ("__main__", "cli"), ("job", "cli")}
# The modules of a floor-1 package that floors 2 and 3 may import: interfaces and code shared by all variants.
OPEN_BELOW = {"prior": ("base", "path"), "densifier": ("base", "refine")}


@cache
def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def part_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE).with_suffix("")
    return "" if relative.parts == ("__init__",) else relative.parts[0]


def imports(path: Path, root: Path = PACKAGE) -> Iterator[tuple[str, list[str]]]:
    """Yield module and names of every import in a file, with relative imports made absolute."""
    package = [root.name, *path.relative_to(root).parts[:-1]]
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            yield ".".join([*base, *([node.module] if node.module else [])]), [a.name for a in node.names]


def own_imports(path: Path) -> Iterator[tuple[str, ...]]:
    """Yield every import of our own as its parts after ``cadam3d``, such as ``("prior", "base")``."""
    for module, names in imports(path):
        head, *rest = module.split(".")
        if head != "cadam3d":
            continue
        if rest:
            yield tuple(rest)
        else:  # from cadam3d import x
            known = {name for name in names if name in FLOORS}
            yield from ((name,) for name in known) if known else iter([("",)])


def arrow_problem(importer: str, target: tuple[str, ...]) -> str | None:
    """Return what is wrong with an import of ``target`` in a part of the package; None if it points down."""
    imported = target[0]
    here, there = FLOORS[importer], FLOORS[imported]
    if importer == imported or (importer, imported) in SIDEWAYS:
        return None
    if there >= here:
        return f"{importer} (floor {here:g}) must not import {'.'.join(target)} (floor {there:g})"
    is_component = (PACKAGE / imported).is_dir() and there in (1.0, 2.0)
    if (
        here in (2.0, 3.0)
        and is_component
        and target[1:2] not in [(name,) for name in OPEN_BELOW.get(imported, ("base",))]
    ):
        return f"{importer} must import only the interface of {imported}, not {'.'.join(target)}"
    return None


def import_graph(package: Path) -> dict[str, set[str]]:
    """Return for each file of a package the files of the same package that it imports, as dotted names."""
    files = {
        ".".join([package.name, *path.relative_to(package).with_suffix("").parts]).removesuffix(
            ".__init__"
        ): path
        for path in package.rglob("*.py")
    }
    graph: dict[str, set[str]] = {}
    for name, path in files.items():
        found = set()
        for module, names in imports(path, package):
            modules = {f"{module}.{each}" for each in names if f"{module}.{each}" in files} or {module}
            found |= modules & files.keys()
        graph[name] = found - {name}
    return graph


def circles(graph: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Return the groups of nodes that reach each other, which are the strongly connected components."""
    reach = {node: reachable(graph, node) for node in graph}
    groups = {frozenset(other for other in reach[node] if node in reach[other]) for node in graph}
    return sorted(sorted(group) for group in groups if group)


def reachable(graph: Mapping[str, Iterable[str]], start: str) -> set[str]:
    """Return the nodes that paths of at least one step lead to."""
    found: set[str] = set()
    ahead = list(graph[start])
    while ahead:
        node = ahead.pop()
        if node not in found:
            found.add(node)
            ahead.extend(graph[node])
    return found


def test_imports_point_down():
    missing = {part_of(path) for path in sources()} - FLOORS.keys()
    assert not missing, f"{missing} have no floor yet. Add them to FLOORS in {__file__}"
    targets = [(path, part_of(path), target) for path in sources() for target in own_imports(path)]
    assert not [(path, problem) for path, part, target in targets if (problem := arrow_problem(part, target))]


@pytest.mark.parametrize(
    ("importer", "target"),
    [
        ("core", ("io", "ply")),
        ("guidance", ("prior", "tiny")),
        ("trainer", ("densifier", "cadam")),
        ("settings", ("sweep", "folder")),
        ("sweep", ("report",)),
        ("commands", ("launch",)),
    ],
)
def test_an_upward_or_sideways_import_is_noticed(importer, target):
    assert arrow_problem(importer, target) is not None


def test_no_files_import_each_other_in_a_circle():
    assert not circles(import_graph(PACKAGE))


@pytest.mark.parametrize(
    "lines",
    [
        {"a": "import {p}.b", "b": "from {p} import a"},
        {"a": "from {p}.b import x", "b": "def run():\n    from {p}.a import y"},
        {"a": "from . import b", "b": "from {p} import c", "c": "from .a import x"},
        {
            "a": "import {p}.part",
            "part/__init__": "from {p}.part.b import x",
            "part/b": "from {p}.a import y",
        },
    ],
)
def test_a_planted_circle_is_noticed(lines, tmp_path):
    package = tmp_path / "planted"
    for name, text in {"__init__": "", "alone": "import {p}.a", **lines}.items():
        path = package / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.format(p="planted"), encoding="utf-8")
    [circle] = circles(import_graph(package))
    assert circle == sorted(f"planted.{name}".replace("/", ".").removesuffix(".__init__") for name in lines)


def test_hydra_is_imported_on_the_upper_floors_only():
    assert not [path for path in sources() if FLOORS[part_of(path)] < HYDRA_FLOOR and imports_hydra(path)]


def imports_hydra(path: Path, package: Path = PACKAGE) -> bool:
    return any(module.split(".")[0] in ("hydra", "omegaconf") for module, _ in imports(path, package))


@cache
def private_names() -> set[str]:
    """Return the private attributes of Hydra's and OmegaConf's classes."""
    classes = (DictConfig, ListConfig, OmegaConf, Override, JobReturn, GlobalHydra, Singleton)
    attributes = {name for each in classes for name in (*dir(each), *getattr(each, "__annotations__", ()))}
    return {name for name in attributes if name.startswith("_") and not name.startswith("__")}


def private_uses(tree: ast.Module) -> list[str]:
    """Return the private modules and attributes of Hydra and OmegaConf that a source uses."""
    private = private_names()
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module]
            names = [part for module in modules if module for part in module.split(".")]
            names += [alias.name for alias in node.names]
            if names[0] in ("hydra", "omegaconf"):
                found += [name for name in names if name.startswith("_")]
        elif isinstance(node, ast.Attribute) and node.attr in private:
            found += [node.attr] if ast.unparse(node.value) not in ("self", "cls") else []
    return found


def test_only_public_parts_of_hydra_and_omegaconf_are_used():
    assert not [(path, uses) for path in sources() if (uses := private_uses(tree_of(path)))]


@pytest.mark.parametrize(
    "line",
    [
        "from hydra._internal.hydra import Hydra",
        "import hydra._internal.utils",
        "node._get_full_key('')",
        "job._return_value",
        "Singleton._instances",
        "BaseContainer._resolvers.clear()",
    ],
)
def test_a_private_part_of_hydra_is_noticed(line):
    assert private_uses(ast.parse(line))


def test_core_imports_only_array_packages_and_the_standard_library():
    allowed = {"torch", "numpy", "kornia", "jaxtyping", "cadam3d", *sys.stdlib_module_names}
    allowed |= {"scipy", "skimage", "fast_simplification", "trimesh"}  # for surfaces
    allowed |= {"tqdm"}  # for bars
    guilty = {
        f"{path.name}: {module}"
        for path in sources()
        if part_of(path) == "core"
        for module, _ in imports(path)
        if module.split(".")[0] not in allowed
    }
    assert not guilty


# Functions that draw from the global generator unless they get another one. The in-place ones are methods.
DRAWS = {"rand", "randn", "randint", "randperm", "multinomial", "normal", "bernoulli", "poisson"}
DRAWS |= {"rand_like", "randn_like", "randint_like"}
DRAWS_IN_PLACE = {"bernoulli_", "cauchy_", "exponential_", "geometric_", "log_normal_", "normal_", "random_"}
DRAWS_IN_PLACE |= {"trunc_normal_", "uniform_"}
OWN_STATE = {"SeedSequence", "Generator", "PCG64", "Philox", "default_rng", "Random", "SystemRandom"}


def global_draws(tree: ast.Module) -> list[str]:
    """Return the calls of a source that read or change the random state of the process.

    Calls inside ``with torch.random.fork_rng(...)`` are left out, because that state is restored.
    """
    full_names = {}  # local name -> what was imported
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            full_names |= {a.asname: a.name for a in node.names if a.asname}
        elif isinstance(node, ast.ImportFrom):
            full_names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    return [name for call in _calls(tree) if _is_global_draw(call, name := _called(call, full_names))]


def _calls(node: ast.AST) -> Iterator[ast.Call]:
    if isinstance(node, ast.With) and "random.fork_rng" in ast.unparse(node.items[0].context_expr):
        return
    if isinstance(node, ast.Call):
        yield node
    for child in ast.iter_child_nodes(node):
        yield from _calls(child)


def _called(call: ast.Call, full_names: dict[str, str]) -> str:
    head, *rest = ast.unparse(call.func).split(".")
    return ".".join([full_names.get(head, head), *rest])


def _is_global_draw(call: ast.Call, name: str) -> bool:
    *modules, last = name.split(".")
    has_generator = any(keyword.arg == "generator" for keyword in call.keywords)
    has_seed = bool(call.args or call.keywords)
    match modules:
        case ["torch"] if last in DRAWS:
            return not has_generator
        case ["torch"] | ["torch", "random" | "default_generator"] | ["torch", "cuda"]:
            return last in {"manual_seed", "manual_seed_all", "seed", "seed_all", "set_rng_state"}
        case ["random"] | ["numpy", "random"]:
            return not (last in OWN_STATE and has_seed)
        case _:
            return last in DRAWS_IN_PLACE and not has_generator


def test_all_randomness_comes_from_a_generator_argument():
    assert not [(path, draws) for path in sources() if (draws := global_draws(tree_of(path)))]


@pytest.mark.parametrize(
    "line",
    [
        "import torch; torch.rand(3)",
        "import torch as t; t.randn_like(x)",
        "from torch import randperm; randperm(3)",
        "import torch; torch.manual_seed(0)",
        "import torch; torch.default_generator.manual_seed(0)",
        "x.normal_()",
        "import torch; torch.nn.init.uniform_(x)",
        "import numpy as np; np.random.seed(0)",
        "import numpy as np; np.random.default_rng()",
        "from numpy.random import normal; normal()",
        "import random; random.shuffle(x)",
        "from random import choice; choice(x)",
    ],
)
def test_a_draw_from_the_global_state_is_noticed(line):
    assert len(global_draws(ast.parse(line))) == 1


@pytest.mark.parametrize(
    "line",
    [
        "import torch; torch.rand(3, generator=generator)",
        "import torch; torch.Generator().manual_seed(0)",
        "generator.manual_seed(0)",
        "x.normal_(generator=generator)",
        "import numpy as np; np.random.SeedSequence(seed).spawn(3)",
        "import random; random.Random(0).shuffle(x)",
        "import torch\nwith torch.random.fork_rng(devices=[]):\n    torch.manual_seed(0)",
    ],
)
def test_a_draw_from_an_explicit_generator_is_allowed(line):
    assert not global_draws(ast.parse(line))


def test_no_class_is_defined_twice():
    places: dict[str, list[str]] = {}
    for path in sources():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path.relative_to(PACKAGE)))
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_outside_of_components_no_file_name_exists_twice():
    """``exporter=mesh`` and ``metric=mesh`` are rightly called so; other files have names of their own."""
    groups = {path.name for path in (PACKAGE.parent / "configs").iterdir() if path.is_dir()}
    names = [path.name for path in sources() if part_of(path) not in groups and path.name != "__init__.py"]
    assert not {name for name in names if names.count(name) > 1}


def test_nothing_is_imported_by_star():
    assert not [path for path in sources() for _, names in imports(path) if "*" in names]


def test_no_module_level_future_annotations():
    """They would turn annotations into strings and thus switch off the checks of shapes."""
    assert not [path for path in sources() for module, _ in imports(path) if module == "__future__"]


def test_the_class_of_a_component_is_never_checked():
    """If an interface does not suffice, it must be changed; ``isinstance`` is not the solution."""
    interfaces = ("CameraSampler", "Initializer", "Rasterizer", "DiffusionPrior", "Guidance", "Densifier")
    interfaces += ("Exporter", "Metric", "Callback", "Background", "Regularizer", "Augmentation", "Exposure")
    guilty = []
    for path in sources():
        for node in ast.walk(tree_of(path)):
            is_check = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            if is_check and node.func.id in ("isinstance", "issubclass") and len(node.args) == 2:
                checked = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                guilty += [f"{path.name}: {name}" for name in checked & set(interfaces)]
    assert not guilty


FILE_NAMES = {
    value
    for name, value in vars(run_folder).items()
    if name.isupper()
    and isinstance(value, str)
    and re.search(r"[./]", value)
    and value != run_folder.CHECKPOINT_PATTERN
}


def test_only_one_module_spells_the_names_of_files_in_a_run_folder():
    """Names of folders such as ``images`` are not checked, because they are ordinary words."""
    nodes = [(path, node) for path in sources() for node in ast.walk(tree_of(path))]
    spelled = [(path, node.value) for path, node in nodes if isinstance(node, ast.Constant)]
    assert {path for path, value in spelled if value in FILE_NAMES} == {Path(run_folder.__file__)}


def test_every_name_is_defined():
    """The linter cannot check this, because the shapes in type hints look like undefined names."""
    assert not [(path, names) for path in sources() if (names := undefined_names(tree_of(path)))]


def undefined_names(tree: ast.Module) -> set[str]:
    """Return the names that a source uses and nowhere defines."""
    known = {*vars(builtins), "__file__"}
    for node in ast.walk(tree):
        match node:
            case ast.Import() | ast.ImportFrom():
                known |= {(each.asname or each.name).partition(".")[0] for each in node.names}
            case ast.FunctionDef() | ast.ClassDef():
                known.add(node.name)
            case ast.arg():
                known.add(node.arg)
            case ast.Name(ctx=ast.Store()):
                known.add(node.id)
            case (
                ast.ExceptHandler(name=str(name))
                | ast.MatchAs(name=str(name))
                | ast.MatchStar(name=str(name))
            ):
                known.add(name)
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    return used - known
