"""Shared fixtures (the command line in this process, small real pipelines), and the order of test files."""

import gc
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from _pytest import runner
from jaxtyping import install_import_hook

# Files with whole runs come first, because each is run by one process and should not be the last to end.
LONG = (
    "test_end_to_end",
    "test_sweeps",
    "test_cuda_sanitizer",
    "test_notebook",
    "test_trainer",
    "test_wrong_values",
    "test_docs",
    "test_learned_priors",
    "test_extending",
    "test_train_prior",
    "test_cuda_sort",
    "test_distill",
    "test_current_folder",
    "test_finished_runs",
    "test_sweep_page",
    "test_site",
    "test_configs",
    "test_traps",
    "test_recipes",
    "test_waiting",
)


# Hydra's own files and those of the package never change.
PACKAGE_FILES = str(Path(__file__).parents[1] / "configs")
FIXED = ("", "structured://", "hydra.conf", "pkg://hydra.conf", PACKAGE_FILES, f"file://{PACKAGE_FILES}")

# With `-m gpu`, only files with one of these words are collected: the marker, or a fixture of the folder
# rasterizer that has a GPU among its parameters.
OF_GPU = re.compile(r"mark\.gpu\b|\b(any_)?backend\b")


def pytest_configure(config):
    # A machine with a GPU may have few packages, and the types are checked wherever the other tests run.
    if config.option.markexpr != "gpu":
        _check_types()
    # The tests start the program a hundred times, and each start would compile every module again.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # No test cuts the power, and on some disks each call waits for milliseconds.
    os.fsync = lambda _: None


def _check_types() -> None:
    """Check the types of all calls in the modules that state shapes.

    The other modules have plain types only, which pyright checks. They make three quarters of all calls, so
    checking them would cost an eighth of the time of the suite.
    """
    package = Path(find_spec("cadam3d").origin).parent
    names = [
        path.relative_to(package.parent).with_suffix("").parts
        for path in package.rglob("*.py")
        if re.search("from jaxtyping import|import .*PerView", path.read_text(encoding="utf-8"))
    ]
    install_import_hook([".".join(parts).removesuffix(".__init__") for parts in names], "typechecker.check")


def pytest_xdist_auto_num_workers():
    """Return one process more than there are cores, because some tests wait for processes or for a signal."""
    return (os.cpu_count() or 1) + 1


def pytest_ignore_collect(collection_path, config):
    """Ignore files without tests of a GPU if only those run, because their imports may not be installed."""
    if config.option.markexpr != "gpu" or not re.fullmatch(r"test_.*\.py", collection_path.name):
        return None
    return None if OF_GPU.search(collection_path.read_text(encoding="utf-8")) else True


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Skip tests that do not fit into the memory of this GPU."""
    try:
        return (yield)
    except (MemoryError, RuntimeError) as error:
        if item.get_closest_marker("gpu") and type(error).__name__ in ("MemoryError", "OutOfMemoryError"):
            pytest.skip("not enough memory on this GPU")
        raise


def pytest_collection_modifyitems(items):
    def place(item):
        return LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG)

    items.sort(key=place)


def pytest_collection_finish():
    # Imported modules and collected tests stay in memory, so the garbage collector need not scan them.
    gc.collect()
    gc.freeze()
    # Composing a configuration makes tens of thousands of objects and hardly any cycles among them.
    gc.set_threshold(50_000, 20, 20)
    _skip_unused_maps()
    _parse_once()
    _set_parents_fast()
    _compose_once()


def _parse_once() -> None:
    """Let OmegaConf parse each text with interpolations once. The trees are only read."""
    from omegaconf import _utils, base, grammar_parser

    base.parse = _utils.parse = cache(grammar_parser.parse)


def _set_parents_fast() -> None:
    """Let OmegaConf set the parents of all nodes without imports and checks of types for each node.

    It does so after every merge, which takes a quarter of the time of every composition.
    """
    from omegaconf import DictConfig, ListConfig
    from omegaconf.base import Box

    set_parents = Box._re_parent

    def set_parents_fast(self):
        content = self.__dict__["_content"]
        if type(self) is DictConfig and type(content) is dict:
            nodes = content.values()
        elif type(self) is ListConfig and type(content) is list:
            nodes = content
        else:
            set_parents(self)
            return
        for node in nodes:
            if node is not None:
                node.__dict__["_parent"] = self
                node._invalidate_flags_cache()
                if isinstance(node, Box):
                    set_parents_fast(node)

    Box._re_parent = set_parents_fast


def _compose_once() -> None:
    """Let Hydra read and place each file once, merge the same files once, and compose each line once.

    Every third composition of the suite repeats an earlier one, and most others differ in plain values only.
    """
    from hydra._internal import config_loader_impl as loader
    from hydra._internal.config_repository import ConfigRepository

    kept: dict[tuple, bytes] = {}
    states: dict[str, tuple] = {}

    def once(sources: Iterable[Any], key: tuple, make: Callable[[], Any]) -> Any:
        """Return what ``make`` has returned for the same files and the same ``key``."""
        paths = [source.path for source in sources]
        states.update((path, _state(path)) for path in paths if path not in states)
        place = (*key, *(states[path] for path in paths))
        if place not in kept:
            kept[place] = pickle.dumps(make())
        # Hydra modifies its input. Unpickling a copy is five times as fast as copy.deepcopy.
        return pickle.loads(kept[place])

    def load_once(self, config_path):
        return once(self.get_sources(), ("load", config_path), lambda: load(self, config_path))

    def place_once(self, default, repo):
        key = ("place", default.config_path, default.package, default.primary)
        return once(repo.get_sources(), key, lambda: place(self, default, repo))

    def list_once(repo, config_name, overrides_list, prepend_hydra, skip_missing):
        values = [each for each in overrides_list if not _is_choice(each, repo)]
        choices = [each for each in overrides_list if _is_choice(each, repo)]
        key = ("list", config_name, skip_missing, *(each.input_line for each in choices))
        arguments = (repo, config_name, choices, prepend_hydra, skip_missing)
        found = once(repo.get_sources(), key, lambda: list_defaults(*arguments))
        found.config_overrides = values
        return found

    def merge_once(self, defaults, repo):
        key = ("merge", *((each.config_path, each.package, each.primary) for each in defaults))
        return once(repo.get_sources(), key, lambda: merge(self, defaults, repo))

    def compose_once(self, config_name, overrides, run_mode, *arguments, **options):
        states.clear()
        make = partial(compose, self, config_name, overrides, run_mode, *arguments, **options)
        if any("searchpath" in line for line in overrides):
            return make()
        return once(self.get_search_path().get_path(), (config_name, run_mode, *overrides), make)

    load, ConfigRepository.load_config = ConfigRepository.load_config, load_once
    list_defaults, loader.create_defaults_list = loader.create_defaults_list, list_once
    hydra = loader.ConfigLoaderImpl
    place, hydra._load_single_config = hydra._load_single_config, place_once
    merge, hydra._compose_config_from_defaults_list = hydra._compose_config_from_defaults_list, merge_once
    compose, hydra.load_configuration = hydra.load_configuration, compose_once


def _is_choice(override: Any, repo: Any) -> bool:
    """Return whether an override may choose an option, as Hydra sees it."""
    is_value = isinstance(override.value(), dict) or not repo.group_exists(override.key_or_group)
    return override.is_sweep_override() or not is_value


def _state(path: str) -> tuple:
    """Return a folder in which Hydra searches, with its files unless no test changes them."""
    found = [] if path in FIXED else sorted(Path(path.removeprefix("file://")).rglob("*.yaml"))
    return (path, *((str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in found))


def _skip_unused_maps() -> None:
    """Let Hydra collect the choices of a file only if its list of defaults refers to one, as in ``${prior}``.

    Nothing else reads them, and collecting them takes a quarter of the time of every composition.
    """
    from hydra._internal import defaults_list

    collect = defaults_list._create_interpolation_map

    def collect_if_used(overrides, defaults, self_added):
        is_used = any(default.is_interpolation() for default in defaults)
        return collect(overrides, defaults, self_added) if is_used else None

    defaults_list._create_interpolation_map = collect_if_used


def _with_room() -> Callable[[Callable[[], Any]], Any]:
    """Return a function that calls its argument, and that leaves half a megabyte for the frames above it."""
    names = " = ".join(f"unused_{i}" for i in range(70_000))
    scope: dict[str, Any] = {}
    source = f"def call(function):\n    if function is None:\n        {names} = None\n    return function()"
    exec(source, scope)
    return scope["call"]


# CPython 3.11 keeps its frames in pieces of 16 KiB, and maps or unmaps memory when a call crosses the end of
# a piece. The deep stacks of Hydra do so again and again, which costs a fifth of the time of some tests. A
# function with very many variables gets a large piece, and the frames above it share what it does not use.
WITH_ROOM = _with_room()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    return WITH_ROOM(lambda: runner.pytest_runtest_protocol(item, nextitem))


class Result(NamedTuple):
    """The result of a command line."""

    code: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """Return the single line of an error, without the name of the program."""
        lines = self.err.strip().splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("cadam3d: ")
        return lines[0].removeprefix("cadam3d: ")


@pytest.fixture(autouse=True)
def _scripts_find_their_folder(monkeypatch):
    """Reset a variable that the command line sets, because with it a script cannot import its own folder."""
    monkeypatch.setenv("PYTHONSAFEPATH", "")


@pytest.fixture
def type_line(monkeypatch, capsys, tmp_path) -> Callable[..., Result]:
    """Return a function that runs ``cadam3d ...`` in an empty folder, in this process."""
    from cadam3d import cli

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    # The program sets this variable; it is restored after the test.
    monkeypatch.setenv("PYTHONSAFEPATH", "1")

    def run(*words: str) -> Result:
        monkeypatch.setattr(sys, "argv", ["cadam3d", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        return Result(int(ended.value.code or 0), captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def pipelines(tmp_path_factory) -> Callable[..., Path]:
    """Return a function that calls a builder of pipelines.py by name and returns its folder."""
    for name in ("diffusers", "transformers"):
        pytest.importorskip(name)
    import pipelines as builders

    built: dict[tuple, Path] = {}

    def build(name: str, **options) -> Path:
        key = (name, *sorted(options.items()))
        if key not in built:
            built[key] = getattr(builders, name)(tmp_path_factory.mktemp(name), **options)
        return built[key]

    return build
