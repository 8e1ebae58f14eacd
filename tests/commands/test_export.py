"""``cadam3d export``: names of files, asset.json, for=, suffixes, and the printed facts about programs."""

import hashlib
import json
import shlex
import threading
from pathlib import Path

import pytest
import torch
from composed import as_yaml
from programs.files import CASES
from splats import make_gaussians

import cadam3d
from cadam3d.core.errors import UserError
from cadam3d.exporter.base import suffix_in
from cadam3d.io.asset_file import read_gaussians
from cadam3d.io.asset_record import axes_of
from cadam3d.io.frames import AXES, UPS
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.lock import taking_turns
from cadam3d.io.mesh import read_mesh
from cadam3d.io.ply import read_ply, write_ply
from cadam3d.settings.compose import compose
from cadam3d.settings.options import config_dir
from cadam3d.settings.output import exporter_classes, exporting

CLASSES = exporter_classes(())
TARGETS = sorted(path.stem for path in (config_dir() / "for").glob("*.yaml"))
SUMMARY = {"prompt": "a red cube", "seed": 3, "steps": 40, "densifier": "cadam", "guidance": "sds"}
SUMMARY |= {"prior": "shapes", "cadam3d": "0.0.1", "torch": "2.9"}


@pytest.fixture
def run_folder(tmp_path) -> Path:
    folder = tmp_path / "a run"
    folder.mkdir()
    settings = as_yaml("prompt=a red cube", "rasterizer=auto")
    (folder / "config.yaml").write_text(settings, encoding="utf-8")
    write_ply(folder / "asset.ply", make_gaussians(6, degree=1), up="-y", pad_sh=0)
    write_json(folder / "summary.json", SUMMARY)
    return folder


def files_in(record: Path) -> dict[str, dict]:
    """Return the entries of an asset.json by the name of the file, after comparing them with the files."""
    found = {entry["name"]: entry for entry in read_json(record)["files"]}
    for name, entry in found.items():
        content = (record.parent / name).read_bytes()
        assert (entry["bytes"], entry["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
    return found


# --- asset.json -------------------------------------------------------------------------------------------


def test_the_files_of_a_run_are_in_exports_and_described_there(run_folder, type_line):
    code, out, _ = type_line("export", f"run={run_folder}", "exporter.ply.pad_sh=2")
    assert code == 0
    assert out.splitlines()[-1].startswith("a run/exports/asset.json")
    record = read_json(run_folder / "exports/asset.json")
    assert list(record) == [
        *("schema", "source", "prompt", "seed", "steps", "densifier", "objective", "prior"),
        *("trained_with", "exported_with", "files"),
    ]
    assert (record["prompt"], record["seed"], record["steps"]) == ("a red cube", 3, 40)
    assert (record["densifier"], record["objective"]) == ("cadam", "sds")
    assert record["trained_with"] == {"cadam3d": "0.0.1", "torch": "2.9"}
    assert record["exported_with"]["torch"] == torch.__version__
    assert record["source"] == {
        "name": "asset.ply",
        "sha256": hashlib.sha256((run_folder / "asset.ply").read_bytes()).hexdigest(),
        "gaussians": 6,
        "sh_degree": 1,
    }
    entry = files_in(run_folder / "exports/asset.json")["asset.ply"]
    assert entry["frame"] == {"up": "-y", "front": "+z", "handedness": "right"}
    assert (entry["format"], entry["gaussians"], entry["sh_degree"], entry["triangles"]) == (
        "ply",
        6,
        2,
        None,
    )


def test_a_second_export_keeps_the_entries_of_unchanged_files_only(run_folder, type_line):
    write_ply(run_folder / "old.ply", read_ply(run_folder / "asset.ply"), up="+z", pad_sh=0)
    folder = run_folder / "exports"
    type_line("export", f"run={run_folder}")
    record = read_json(folder / "asset.json")
    [entry] = record["files"]
    for name in ("kept.ply", "changed.ply", "gone.ply", "link.ply"):
        (folder / name).write_bytes((folder / "asset.ply").read_bytes())
    (folder / "link.ply").unlink()
    (folder / "link.ply").symlink_to(folder / "asset.ply")
    record["files"] += [
        entry | {"name": name} for name in ("kept.ply", "changed.ply", "gone.ply", "link.ply")
    ]
    record["files"] += [entry | {"name": "../asset.ply"}, entry | {"up": "-y"}, 5, {"name": "kept.ply"}]
    write_json(folder / "asset.json", record)
    (folder / "changed.ply").write_bytes(b"another file")
    (folder / "gone.ply").unlink()
    assert type_line("export", f"run={run_folder}", "exporter.ply.up=+z").code == 0
    files = files_in(folder / "asset.json")
    assert list(files) == ["asset.ply", "kept.ply"]
    assert files["kept.ply"] == entry | {"name": "kept.ply"}
    assert files["asset.ply"]["frame"]["up"] == "+z"


def test_a_record_describes_one_asset(run_folder, type_line, tmp_path):
    type_line("export", f"run={run_folder}", "output=here")
    (tmp_path / "here/asset.ply").rename(tmp_path / "here/first.ply")
    record = read_json(tmp_path / "here/asset.json")
    record["files"][0]["name"] = "first.ply"
    write_json(tmp_path / "here/asset.json", record)
    write_ply(tmp_path / "other.ply", make_gaussians(4), up="+y", pad_sh=0)
    assert type_line("export", "ply=other.ply", "output=here").code == 0
    record = read_json(tmp_path / "here/asset.json")
    assert list(files_in(tmp_path / "here/asset.json")) == ["asset.ply"]
    assert record["source"]["name"] == "other.ply"
    assert {record[name] for name in ("prompt", "seed", "steps", "densifier", "objective")} == {None}


@pytest.mark.parametrize("content", ["my own", "{}", '{"schema": 2, "source": {}, "files": []}', "[]"])
def test_an_asset_json_of_another_origin_is_never_overwritten(content, run_folder, type_line, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/asset.json").write_text(content)
    message = type_line("export", f"run={run_folder}", "output=mine").message
    assert message == (
        "output: mine holds an asset.json that cadam3d export has not written. Try: output=mine-2"
    )
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["asset.json"]
    assert (tmp_path / "mine/asset.json").read_text() == content


@pytest.mark.parametrize("output", ["a run", "a run/", "a run/asset.ply", "a run/../a run/asset.ply"])
def test_the_exported_file_itself_is_never_overwritten(output, run_folder, type_line):
    before = (run_folder / "asset.ply").read_bytes()
    message = type_line("export", f"run={run_folder}", f"output={output}", "exporter.ply.up=+z").message
    assert message == (
        "output: expected another place than a run/asset.ply, which is exported, got 'the same'. "
        "Try: 'output=a run/exports'"
    )
    assert (run_folder / "asset.ply").read_bytes() == before
    assert type_line("export", f"run={run_folder}", f"output={output[:5]}", "exporter=[splat]").code == 0


def test_a_run_of_a_stranger_adds_nothing_but_texts_and_counts(run_folder, type_line):
    (run_folder / "summary.json").unlink()
    settings = {"prompt": "\u202e" + "x" * 1000, "seed": [1, {"a": 2}]}
    (run_folder / "config.yaml").write_text(json.dumps(settings))
    assert type_line("export", f"run={run_folder}").code == 0
    record = read_json(run_folder / "exports/asset.json")
    assert record["prompt"] == settings["prompt"]
    assert record["seed"] is None
    assert record["trained_with"] == {"cadam3d": None, "torch": None}


def test_every_format_is_written_and_described_as_it_is_read_back(run_folder, type_line):
    words = (
        "exporter=[ply,compressed_ply,splat,spz,glb,mesh,html]",
        "exporter.mesh.resolution=16",
        "exporter.mesh.level=0.1",
    )
    assert type_line("export", f"run={run_folder}", *words).code == 0
    files = files_in(run_folder / "exports/asset.json")
    assert list(files) == [
        *("asset.compressed.ply", "asset.glb", "asset.ply", "asset.splat", "asset.spz"),
        *("asset_mesh.glb", "viewer.html"),
    ]
    for name in ("asset.compressed.ply", "asset.ply", "asset.splat", "asset.spz"):
        read = read_gaussians(run_folder / "exports" / name, up=files[name]["frame"]["up"])
        assert (len(read), read.sh_degree) == (files[name]["gaussians"], files[name]["sh_degree"])
    assert files["asset.splat"]["sh_degree"] == 0
    assert files["asset_mesh.glb"]["triangles"] == len(read_mesh(run_folder / "exports/asset_mesh.glb").faces)
    assert (files["asset_mesh.glb"]["gaussians"], files["viewer.html"]["frame"]) == (None, None)


def test_every_format_of_gaussians_can_have_fewer_and_says_so(run_folder, type_line):
    formats = ["ply", "compressed_ply", "splat", "spz", "glb", "html"]
    words = [f"exporter.{name}.count=4" for name in formats[:-1]]
    words += ["exporter.html.fraction=0.3", "exporter.splat.simplify=opacity"]
    words += ["exporter.spz.simplify=contribution", "exporter=[" + ",".join(formats) + "]"]
    code, out, _ = type_line("export", f"run={run_folder}", *words)
    assert code == 0
    files = files_in(run_folder / "exports/asset.json")
    assert [entry["gaussians"] for entry in files.values()] == [4, 4, 4, 4, 4, 2]
    assert out.count(", 4 Gaussians") == 5
    for name in ("asset.compressed.ply", "asset.ply", "asset.splat", "asset.spz", "asset.glb"):
        up = files[name]["frame"]["up"]
        assert len(read_gaussians(run_folder / "exports" / name, up=None if up == "+y" else up)) == 4
    assert read_json(run_folder / "exports/asset.json")["source"]["gaussians"] == 6


def test_count_beside_fraction_is_one_line(run_folder, type_line):
    both = ("exporter.ply.count=4", "exporter.ply.fraction=0.1")
    code, _, err = type_line("export", f"run={run_folder}", *both)
    expected = "exporter.ply.fraction: expected null with count=4, got 0.1. Try: exporter.ply.fraction=null"
    assert (code, err.strip()) == (1, f"cadam3d: {expected}")


@pytest.mark.parametrize(
    ("prompt", "words", "title"),
    [
        ("a </title><b>cube", (), "a &lt;/title&gt;&lt;b&gt;cube"),
        ("a ${oc.env:HOME} cube", (), "a ${oc.env:HOME} cube"),
        ("a\x1b[31m\ncube", (), "a [31m cube"),
        (7, (), "a red cube"),
        ("a cube", ("exporter.html.title=mine",), "mine"),
    ],
)
def test_a_page_has_the_prompt_of_its_run_as_its_title(prompt, words, title, run_folder, type_line):
    write_json(run_folder / "summary.json", SUMMARY | {"prompt": prompt})
    assert type_line("export", f"run={run_folder}", "output=page.html", *words).code == 0
    assert f"<title>{title}</title>" in Path("page.html").read_text(encoding="utf-8")


def test_a_failed_exporter_costs_only_its_own_file(run_folder, type_line):
    (run_folder / "exports/preview.png").mkdir(parents=True)
    code, out, err = type_line(
        "export", f"run={run_folder}", "exporter=[preview,ply]", "exporter.preview.size=8"
    )
    assert code == 0
    assert err.startswith("Warning: exporter.preview: ")
    assert "asset.ply" in out
    assert list(files_in(run_folder / "exports/asset.json")) == ["asset.ply"]


def test_the_failure_of_the_only_exporter_is_one_message(run_folder, type_line):
    words = ("exporter=[mesh]", "exporter.mesh.level=0.999")
    code, out, err = type_line("export", f"run={run_folder}", *words)
    assert (code, out) == (1, "")
    assert err.startswith("cadam3d: exporter.mesh.level: expected ")
    assert err.count("\n") == 1


def test_a_single_file_comes_alone(run_folder, type_line, tmp_path):
    assert type_line("export", f"run={run_folder}", "output=alone/thing.ply").code == 0
    assert [path.name for path in (tmp_path / "alone").iterdir()] == ["thing.ply"]


@pytest.mark.parametrize("up", UPS)
def test_the_frame_says_where_the_object_looks(up):
    frame = axes_of(up)
    axes = torch.tensor(AXES[up])
    for name, direction in ((frame["up"], [0, 0, 1]), (frame["front"], [1, 0, 0])):
        unit = torch.eye(3, dtype=torch.int64)["xyz".index(name[1])] * int(f"{name[0]}1")
        assert (axes @ torch.tensor(direction)).tolist() == unit.tolist()
    assert torch.linalg.det(axes.double()) == 1


def test_two_exports_into_one_folder_take_turns(tmp_path):
    waits = threading.Event()

    def second() -> None:
        with taking_turns(tmp_path, waits.set):
            (tmp_path / "second").touch()

    thread = threading.Thread(target=second)
    with taking_turns(tmp_path, lambda: None):
        thread.start()
        assert waits.wait(60)
        assert not list(tmp_path.iterdir())
    thread.join(60)
    assert [path.name for path in tmp_path.iterdir()] == ["second"]


# --- for= -------------------------------------------------------------------------------------------------


def row_of(target: str) -> str:
    """Return the line of docs/exporting.md about a program."""
    page = (Path(cadam3d.__file__).parent.parent / "docs/exporting.md").read_text(encoding="utf-8")
    [row] = [line for line in page.splitlines() if f"| `for={target}` |" in line]
    return row


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_writes_a_file_that_is_upright_there(target):
    """The page says so, and for most programs the tests with these programs have measured it."""
    [(name, node)] = compose([f"for={target}"], "export").exporter.items()
    row = row_of(target)
    assert f"`{CLASSES[name].files[0]}`" in row
    assert f"{node.up} up" in row or name == "mesh"
    measured = [case for case in CASES.get(row.split("|")[1].strip(), ()) if case.exporter == name]
    assert {case.upright for case in measured} <= {node.up}


@pytest.mark.parametrize("target", ["three", "spark", "blender"])
def test_a_target_chooses_an_exporter_and_its_axes(target, run_folder, type_line):
    [(name, node)] = compose([f"for={target}"], "export").exporter.items()
    words = ["exporter.mesh.resolution=16", "exporter.mesh.level=0.1"] if name == "mesh" else []
    code, out, _ = type_line("export", f"run={run_folder}", f"for={target}", *words)
    assert code == 0
    assert f", {node.up} up" in out
    [entry] = files_in(run_folder / "exports/asset.json").values()
    assert (entry["format"], entry["frame"]["up"]) == (name, node.up)


def test_a_target_and_an_exporter_are_refused_but_a_setting_of_the_exporter_wins(run_folder, type_line):
    message = type_line("export", f"run={run_folder}", "for=spark", "exporter=[ply]").message
    expected = "exporter: expected for= alone, got 'exporter=[ply]'. Try: for=spark"
    assert message == expected
    assert type_line("export", f"run={run_folder}", "for=spark", "exporter.ply.up=-y").code == 0
    [entry] = files_in(run_folder / "exports/asset.json").values()
    assert entry["frame"]["up"] == "-y"


def test_a_target_decides_the_format_of_a_named_file(run_folder, type_line, tmp_path):
    assert type_line("export", f"run={run_folder}", "for=spark", "output=a.ply").code == 0
    assert b"up=+y" in (tmp_path / "a.ply").read_bytes()[:200]
    message = type_line("export", f"run={run_folder}", "for=spark", "output=a.glb").message
    assert "1 file(s) with .ply are written" in message


# --- suffixes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "added"),
    [
        (["output=a.ply"], ["exporter=[ply]"]),
        (["output=a.COMPRESSED.ply"], ["exporter=[compressed_ply]"]),
        (["output=compressed.ply"], ["exporter=[ply]"]),
        (["output=.compressed.ply"], ["exporter=[ply]"]),
        (["output=a.glb"], ["exporter=[glb]"]),
        (["output=a.glb", "exporter.mesh.up=+z"], ["exporter=[mesh]", "exporter.mesh.format=glb"]),
        (["output=a.obj"], ["exporter=[mesh]", "exporter.mesh.format=obj"]),
        (["output=a.obj", "exporter=[mesh]"], ["exporter.mesh.format=obj"]),
        (["output=a.ply", "exporter=[mesh]"], ["exporter.mesh.format=ply"]),
        (["output=a.ply", "exporter=[mesh]", "exporter.mesh.format=obj"], []),
        (["output=a.glb", "for=three"], []),
        (["output=a.glb", "exporter=[ply]"], []),
        (["output=a.glb", "exporter=[]"], []),
        (["output=a.glb/"], []),
        (["output=.ply"], []),
        (["output=a"], []),
        (["run=a.ply"], []),
    ],
)
def test_a_suffix_chooses_the_exporter_unless_the_line_does(words, added):
    assert exporting(words) == words + added


def test_every_suffix_of_an_exporter_chooses_one_that_writes_it():
    for cls in CLASSES.values():
        for file in cls.files:
            suffix = suffix_in(file)
            [word, *_] = exporting([f"output=x{suffix.upper()}"])[1:]
            chosen = CLASSES[word.removeprefix("exporter=[").removesuffix("]")]
            assert suffix in map(suffix_in, chosen.files)


def test_an_exporter_from_elsewhere_is_chosen_by_its_suffix(tmp_path, monkeypatch):
    (tmp_path / "elsewhere.py").write_text(
        "from cadam3d.exporter.glb import GlbExporter\n\n\n"
        "class Xyz(GlbExporter):\n    files = ('points.xyz',)\n"
    )
    (tmp_path / "exporter").mkdir()
    (tmp_path / "exporter/xyz.yaml").write_text("# @package exporter.xyz\n_target_: elsewhere.Xyz\n")
    monkeypatch.syspath_prepend(tmp_path)
    words = ["output=a.xyz"]
    assert exporting(words, [tmp_path, config_dir()]) == [*words, "exporter=[xyz]"]
    with pytest.raises(UserError, match=r"output: expected a file with suffix .*\|\.ply\|.*, got 'a\.xyz'"):
        exporting(words)


# --- what is printed --------------------------------------------------------------------------------------


def test_the_lines_about_a_file_name_its_size_content_and_axes(run_folder, type_line):
    first, last = type_line("export", f"run={run_folder}", "output=out").out.splitlines()
    size = Path("out/asset.ply").stat().st_size
    assert first == f"out/asset.ply  {size / 1e6:.3f} MB, 6 Gaussians, -y up"
    assert last.endswith("describes these files")


# --- hints and assets -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ("output=",),
        ("output=taken",),
        ("output=asset.ply", "exporter=[ply,glb]"),
        ("output=taken.xyz",),
    ],
)
def test_no_hint_writes_to_a_path_that_exists(run_folder, type_line, tmp_path, words):
    for name in ("exports", "asset"):
        (tmp_path / name).mkdir()
    for name in ("taken", "taken.xyz"):
        (tmp_path / name).write_text("mine")
    done = type_line("export", f"run={run_folder}", *words)
    assert done.code == 1
    [hint] = shlex.split(done.message.partition(" Try: ")[2])
    assert hint.startswith("output=")
    assert not Path(hint.removeprefix("output=")).exists()
    assert type_line("export", f"run={run_folder}", *words[1:], hint).code == 0


@pytest.mark.parametrize("kind", ["sog", "ksplat", "splat", "spz", "glb", "compressed.ply"])
@pytest.mark.parametrize("command", ["render", "export"])
def test_another_format_beside_an_asset_costs_the_asset_nothing(type_line, tmp_path, kind, command):
    if kind in ("sog", "ksplat"):
        pytest.importorskip("gaussforge")
    write_ply(tmp_path / "asset.ply", make_gaussians(6, degree=0), up="-y", pad_sh=0)
    asset = (tmp_path / "asset.ply").read_bytes()
    assert type_line("export", "ply=asset.ply", f"output=asset.{kind}").code == 0
    words = [
        "exporter=[images]",
        "exporter.images.views=1",
        "exporter.images.size=16",
        "rasterizer=auto",
    ]
    done = type_line(command, f"ply=asset.{kind}", *(words if command == "render" else []))
    assert done.code == 0
    assert "Try: " not in done.err
    assert (tmp_path / "asset.ply").read_bytes() == asset


# --- wrong places -----------------------------------------------------------------------------------------
