"""The house rules that can be read off the source: imports point down, Hydra stays upstairs."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "cadam3d"
TOP = ("cli", "launch", "settings", "sweep", "commands", "report", "__main__")
FLOORS = {  # part of cadam3d -> floor; parts of one floor may meet only as MAY_MEET says
    **dict.fromkeys(("core",), 0.0),
    **dict.fromkeys(("io",), 0.5),  # core, then io
    **dict.fromkeys(("camera", "background", "initializer", "rasterizer", "prior", "densifier"), 1.0),
    **dict.fromkeys(("augmentation", "optimizer", "exposure", "regularizer", "exporter", "metric"), 1.0),
    **dict.fromkeys(("state", "callback", "guidance"), 2.0),
    **dict.fromkeys(("trainer",), 3.0),
    **dict.fromkeys(TOP, 4.0),
    "": -1.0,  # cadam3d itself: the version
}
MAY_MEET = {("callback", "state"), *((one, other) for one in TOP for other in TOP)}
# What the floors above may see of a floor-1 package: interfaces, and what is shared by all variants.
OPEN_BELOW = {"prior": ("base", "path"), "densifier": ("base", "refine")}


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE).with_suffix("")
    return "" if relative.parts == ("__init__",) else relative.parts[0]


def imports(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Module and names of every import in a file, lazy ones included; relative imports made absolute."""
    package = ["cadam3d", *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            yield ".".join([*base, *([node.module] if node.module else [])]), [a.name for a in node.names]


def own_imports(path: Path) -> Iterator[tuple[str, ...]]:
    """The parts after ``cadam3d`` of every import of our own, such as ``("prior", "base")``."""
    for module, names in imports(path):
        head, *rest = module.split(".")
        if head != "cadam3d":
            continue
        if rest:
            yield tuple(rest)
        else:  # from cadam3d import x: a module or a public name of the package
            known = {name for name in names if name in FLOORS}
            yield from ((name,) for name in known) if known else iter([("",)])


def arrow_problem(importer: str, target: tuple[str, ...]) -> str | None:
    imported = target[0]
    here, there = FLOORS[importer], FLOORS[imported]
    if importer == imported or (importer, imported) in MAY_MEET:
        return None
    if there >= here:
        return f"{importer} (floor {here:g}) must not import {'.'.join(target)} (floor {there:g})"
    is_component = (PACKAGE / imported).is_dir() and there in (1.0, 2.0)
    if (
        here in (2.0, 3.0)
        and is_component
        and target[1:2] not in [(name,) for name in OPEN_BELOW.get(imported, ("base",))]
    ):
        return f"{importer} must see only the interface of {imported}, not {'.'.join(target)}"
    return None


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    part = part_of(path)
    assert part in FLOORS, f"{part} has no floor yet: give it one in {__file__}"
    problems = [problem for target in own_imports(path) if (problem := arrow_problem(part, target))]
    assert not problems


@pytest.mark.parametrize(
    ("importer", "target"),
    [
        ("core", ("io", "ply")),
        ("densifier", ("prior", "base")),
        ("exporter", ("rasterizer", "base")),
        ("guidance", ("prior", "tiny")),
        ("trainer", ("densifier", "cadam")),
        ("trainer", ("callback", "metrics")),
        ("io", ("trainer",)),
        ("state", ("callback", "base")),
        ("camera", ("settings",)),
    ],
)
def test_a_wrong_arrow_is_noticed(importer, target):
    assert arrow_problem(importer, target) is not None


@pytest.mark.parametrize(
    ("importer", "target"),
    [
        ("io", ("core", "gaussians")),
        ("guidance", ("prior", "path")),
        ("trainer", ("densifier", "base")),
        ("callback", ("state",)),
        ("commands", ("prior", "shapes")),
    ],
)
def test_a_right_arrow_is_allowed(importer, target):
    assert arrow_problem(importer, target) is None


def test_hydra_lives_on_the_top_floor_only():
    guilty = {
        str(path.relative_to(PACKAGE))
        for path in sources()
        if part_of(path) not in TOP
        for module, _ in imports(path)
        if module.split(".")[0] in ("hydra", "omegaconf")
    }
    assert not guilty


def test_core_knows_tensors_and_the_standard_library_only():
    allowed = {"torch", "numpy", "kornia", "jaxtyping", "cadam3d", *sys.stdlib_module_names}
    guilty = {
        f"{path.name}: {module}"
        for path in sources()
        if part_of(path) == "core"
        for module, _ in imports(path)
        if module.split(".")[0] not in allowed
    }
    assert not guilty


# Draw from the generator of the process unless they are given another; the in-place ones are methods.
DRAWS = {"rand", "randn", "randint", "randperm", "multinomial", "normal", "bernoulli", "poisson"}
DRAWS |= {"rand_like", "randn_like", "randint_like"}
DRAWS_IN_PLACE = {"bernoulli_", "cauchy_", "exponential_", "geometric_", "log_normal_", "normal_", "random_"}
DRAWS_IN_PLACE |= {"trunc_normal_", "uniform_"}
OWN_STATE = {"SeedSequence", "Generator", "PCG64", "Philox", "default_rng", "Random", "SystemRandom"}


def global_draws(source: str) -> list[str]:
    """What ``source`` calls that reads or moves the random state of the process.

    Inside ``with torch.random.fork_rng(...)`` anything goes: that state is put back.
    """
    tree = ast.parse(source)
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


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_all_randomness_comes_from_a_generator_that_was_handed_in(path):
    assert not global_draws(path.read_text(encoding="utf-8"))


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
    assert len(global_draws(line)) == 1


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
def test_a_draw_from_a_state_of_its_own_is_allowed(line):
    assert not global_draws(line)


def test_nothing_is_imported_by_star():
    assert not [path for path in sources() for _, names in imports(path) if "*" in names]


def test_no_folder_is_called_utils():
    names = {part for path in sources() for part in path.relative_to(PACKAGE).with_suffix("").parts}
    assert not names & {"utils", "util", "helpers", "misc", "common"}


def test_no_module_level_future_annotations():
    """They would turn the shapes into strings, and the shape checks off."""
    assert not [path for path in sources() for module, _ in imports(path) if module == "__future__"]


def test_components_are_not_told_apart_by_their_class():
    """No ``isinstance`` against a component: an interface that does not suffice is to be changed instead."""
    interfaces = ("CameraSampler", "Initializer", "Rasterizer", "DiffusionPrior", "Guidance", "Densifier")
    interfaces += ("Exporter", "Metric", "Callback", "Background", "Regularizer", "Augmentation", "Exposure")
    guilty = []
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_check = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            if is_check and node.func.id in ("isinstance", "issubclass") and len(node.args) == 2:
                asked = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                guilty += [f"{path.name}: {name}" for name in asked & set(interfaces)]
    assert not guilty
