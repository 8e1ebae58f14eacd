"""The commands render, export, eval and view, with a run folder, a sweep folder or a single file."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from composed import as_yaml

from cadam3d.commands import view
from cadam3d.commands.render import default_labels
from cadam3d.core.gaussians import Gaussians
from cadam3d.io import caption
from cadam3d.io.caption import Caption
from cadam3d.io.image import write_png_bytes
from cadam3d.io.jsonl import read_json, write_json
from cadam3d.io.ply import read_ply, write_ply
from cadam3d.sweep.folder import Job, Plan, write_plan

SMALL = ("metric.fidelity.views=2", "metric.fidelity.elevations_deg=[0]", "metric.fidelity.size=24")


@pytest.fixture
def gaussians() -> Gaussians:
    draw = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(6, 3, generator=draw) * 0.3,
        log_scales=torch.full((6, 3), -1.5),
        quats=torch.randn(6, 4, generator=draw),
        opacity_logits=torch.randn(6, generator=draw),
        sh=torch.randn(6, 1, 3, generator=draw),
    )


def make_run(folder: Path, gaussians: Gaussians, *overrides: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    settings = as_yaml("prompt=a red cube", "rasterizer=auto", *overrides)
    (folder / "config.yaml").write_text(settings, encoding="utf-8")
    write_ply(folder / "asset.ply", gaussians, up="-y", pad_sh=0)
    return folder


@pytest.fixture
def run_folder(tmp_path, gaussians) -> Path:
    return make_run(tmp_path / "a run", gaussians)


@pytest.mark.parametrize("command", ["render", "export", "view"])
@pytest.mark.parametrize(
    ("words", "got", "hint"),
    [
        ((), "neither", "run=outputs/latest"),
        (("run=a", "ply=b"), "both", "ply=null"),
    ],
)
def test_exactly_one_asset_must_be_named(command, words, got, hint, type_line):
    message = type_line(command, *words).message
    assert message == f"run, ply: expected one of them, got {got}. Try: {hint}"


@pytest.mark.parametrize("command", ["render", "export", "view", "eval"])
def test_a_folder_without_a_run_is_named(command, type_line, tmp_path):
    (tmp_path / "empty").mkdir()
    for place in ("nowhere", "empty"):
        code, _, err = type_line(command, f"run={place}")
        assert code == 1
        assert err.startswith(
            f"cadam3d: run: expected the folder of a run, with a config.yaml, got {place!r}. Try: "
        )


def test_a_broken_file_is_one_message(type_line, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nnot really")
    code, _, err = type_line("render", "ply=broken.ply")
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "broken.ply" in err


def test_render_writes_numbered_images_and_nothing_else(run_folder, type_line, tmp_path):
    words = ("exporter=[images]", "exporter.images.size=16", "exporter.images.views=3")
    code, out, _ = type_line("render", f"run={run_folder}", *words, "exporter.images.elevations_deg=[0,30]")
    assert code == 0
    names = sorted(path.name for path in (run_folder / "render/images").iterdir())
    assert names[:2] == ["000_az000_el+00.png", "001_az120_el+00.png"]
    assert len(names) == 6
    assert "6 file(s) of 6 Gaussians" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a run"]


def test_render_accepts_a_file_and_an_output_folder(run_folder, type_line, tmp_path):
    (run_folder / "asset.ply").rename(tmp_path / "thing.ply")
    words = ("exporter=[images]", "exporter.images.size=16", "exporter.images.views=1")
    assert type_line("render", "ply=thing.ply", "output=some (pictures)", *words)[0] == 0
    assert len(list((tmp_path / "some (pictures)/images").iterdir())) == 1


TINY = ("exporter.images.size=8", "exporter.turntable.size=8", "exporter.turntable.views=4")


def test_render_into_a_used_folder_leaves_no_older_picture_and_no_file_of_the_user_is_removed(
    run_folder, type_line
):
    words = ("render", f"run={run_folder}", "exporter=[images]", "exporter.images.size=8")
    assert type_line(*words, "exporter.images.views=5", "exporter.images.elevations_deg=[-90,0]").code == 0
    images = run_folder / "render/images"
    for name in ("mine.png", "000.png", "000_az000_el+00.png.txt", "notes_000_az000_el+00.png"):
        (images / name).touch()
    own = {path.name for path in images.iterdir() if path.stat().st_size == 0}
    assert type_line(*words, "exporter.images.views=2").code == 0
    assert {path.name for path in images.iterdir()} == own | {"000_az000_el+20.png", "001_az180_el+20.png"}
    assert [path.name for path in images.parent.iterdir()] == ["images"]


def test_a_render_that_fails_halfway_leaves_the_older_pictures(run_folder, type_line, monkeypatch):
    words = ("render", f"run={run_folder}", "exporter=[images]", "exporter.images.size=8")
    type_line(*words, "exporter.images.views=2")
    before = {path: path.read_bytes() for path in (run_folder / "render").rglob("*.png")}

    def fail(path, image):
        if "002" in path.name:
            raise KeyboardInterrupt
        write_png_bytes(path, image)

    monkeypatch.setattr("cadam3d.exporter.images.write_png_bytes", fail)
    assert type_line(*words, "exporter.images.views=4").code == 130
    assert {
        path: path.read_bytes() for path in (run_folder / "render").rglob("*") if path.is_file()
    } == before


def small(output: str) -> tuple[str, ...]:
    """Return settings that make the pictures for ``output`` small."""
    if output == "q.png":
        return TINY[:1]
    return {".mp4": TINY[1:], ".png": ("exporter.preview.size=8",)}.get(Path(output).suffix.lower(), TINY)


@pytest.mark.parametrize("command", ["render", "export"])
@pytest.mark.parametrize("name", ["big.mp4", "deep/down/a.PNG", "torus.ply", "Torus.Ply"])
def test_the_suffix_of_a_file_chooses_its_exporter(command, name, run_folder, type_line, tmp_path):
    words = () if name.lower().endswith(".ply") else small(name)
    assert type_line(command, f"run={run_folder}", f"output={name}", *words).code == 0
    assert (tmp_path / name).stat().st_size > 0
    assert len(list(tmp_path.rglob("*"))) == 3 + len(Path(name).parts)


@pytest.mark.parametrize(
    "output",
    [
        *("", "/", "big.bmp", "big.mp4 ", "run.v2", "q.png"),
        *("a file", "a file/", "a file/x.png", "a file/x/y"),
        *("/proc/nowhere", "/proc/x.png", "/dev/null", "/dev/null/x.mp4", "x" * 300 + ".png"),
    ],
)
def test_a_place_that_cannot_be_used_is_one_message_with_a_place_that_works(
    output, run_folder, type_line, tmp_path
):
    (tmp_path / "a file").write_text("my own")
    before = sorted(tmp_path.rglob("*"))
    # A single picture file cannot hold the eight views that exporter=images writes.
    more = ("exporter=[images]",) if output == "q.png" else ()
    message = type_line("render", f"run={run_folder}", *small(output), *more, f"output={output}").message
    assert message.startswith("output: ")
    assert sorted(tmp_path.rglob("*")) == before
    [word] = shlex.split(message.rpartition("Try: ")[2])
    place = Path(word.removeprefix("output="))
    try:
        sizes = TINY[:1] if more else small(place.name)
        assert type_line("render", f"run={run_folder}", *sizes, *more, word).code == 0
    finally:
        shutil.rmtree(place, ignore_errors=True)
        place.unlink(missing_ok=True)
    assert (tmp_path / "a file").read_text() == "my own"


@pytest.mark.parametrize("output", ["frames/", "frames.v2/", "frames.mp4/", "there.v2", "~/pictures"])
def test_a_slash_or_a_folder_that_exists_makes_a_folder(output, run_folder, type_line, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "there.v2").mkdir()
    assert type_line("render", f"run={run_folder}", *TINY, f"output={output}").code == 0
    assert (tmp_path / output.removeprefix("~/") / "turntable.mp4").is_file()


def test_export_names_its_file_and_turns_its_axes(run_folder, gaussians, type_line, tmp_path):
    code, out, _ = type_line("export", f"run={run_folder}", "output=deep/thing.ply", "exporter.ply.up=+y")
    assert code == 0
    assert out.startswith("deep/thing.ply")
    assert b"asset" not in (tmp_path / "deep/thing.ply").read_bytes()[:64]
    again = read_ply(tmp_path / "deep/thing.ply")
    torch.testing.assert_close(again.means, gaussians.means)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["thing.ply"]


def test_export_without_output_leaves_the_asset_of_the_run_alone(run_folder, type_line):
    before = (run_folder / "asset.ply").read_bytes()
    assert type_line("export", f"run={run_folder}", "exporter.ply.pad_sh=3")[0] == 0
    assert (run_folder / "asset.ply").read_bytes() == before
    assert len((run_folder / "exports/asset.ply").read_bytes()) > len(before)


def test_export_to_an_unknown_format_lists_those_that_exist(run_folder, type_line):
    code, _, err = type_line("export", f"run={run_folder}", "exporter=[fbx]")
    assert code == 1
    assert "|ply|" in err
    code, _, err = type_line("export", f"run={run_folder}", "output=thing.fbx")
    assert code == 1
    assert "|.ply|" in err


def test_eval_measures_against_the_truth_of_the_shapes_prior(run_folder, type_line):
    code, out, _ = type_line("eval", f"run={run_folder}", *SMALL)
    assert code == 0
    result = read_json(run_folder / "eval.json")
    assert 0 < result["psnr"] < 40
    assert -1 <= result["ssim"] <= 1
    assert result["num_gaussians"] == 6
    assert result["asset_bytes"] == (run_folder / "asset.ply").stat().st_size
    assert "psnr" in out


def test_eval_notes_which_numbers_are_missing_without_true_images(tmp_path, gaussians, type_line):
    folder = make_run(tmp_path / "run", gaussians, "prior=tiny")
    code, out, _ = type_line("eval", f"run={folder}", *SMALL)
    result = read_json(folder / "eval.json")
    assert code == 0
    assert "psnr" not in result
    assert result["num_gaussians"] == 6
    assert "has no true images" in out


def make_sweep(folder: Path, *names: str) -> Path:
    folder.mkdir()
    jobs = [Job("", name, [], {}) for name in names]
    write_plan(folder, Plan(cwd=str(folder), flags=[], threads=None, jobs=jobs))
    return folder


def test_eval_of_a_sweep_measures_every_job_and_reports_those_that_fail(tmp_path, gaussians, type_line):
    sweep = make_sweep(tmp_path / "sweep", "b", "a", "never-started", "c")
    for name in ("a", "b", "c", "of-another-sweep"):
        make_run(sweep / name, gaussians)
    (sweep / "a/asset.ply").unlink()
    code, _, err = type_line("eval", "run=sweep", *SMALL)
    assert code == 0
    results = read_json(sweep / "eval.json")
    assert [Path(result["run"]).name for result in results] == ["b", "a", "never-started", "c"]
    assert ["psnr" in result for result in results] == [True, False, False, True]
    assert "cadam3d: a: " in err
    assert "cadam3d: never-started: " in err
    assert (sweep / "c/eval.json").is_file()


def test_eval_of_a_sweep_without_any_asset_fails(tmp_path, type_line):
    make_sweep(tmp_path / "sweep", "a")
    assert type_line("eval", "run=sweep")[0] == 1


def test_eval_compares_two_arms_of_a_sweep_without_measuring_them(tmp_path, type_line):
    """Neither arm is a densifier of the package, and no job has an asset that could be measured."""
    facts = {"outcome": "finished", "warnings": [], "seed": 0, "seconds": 2.0, "numbers": {}}
    jobs = []
    for i in range(7):
        for arm, count in (("mine", 300 + i), ("other", 100)):
            name, prompt = f"{arm}{i}", f"object {i}"
            jobs.append(Job(arm, name, [], {"prompt": prompt, "densifier": "plugin"}))
            (tmp_path / "sweep" / name).mkdir(parents=True)
            summary = {**facts, "prompt": prompt, "num_gaussians": count}
            write_json(tmp_path / "sweep" / name / "summary.json", summary)
    write_plan(tmp_path / "sweep", Plan(cwd=str(tmp_path), flags=[], threads=None, jobs=jobs))
    code, out, _ = type_line("eval", "run=sweep", "arms=[mine,other]")
    assert code == 0
    # Of the 28 means of two prompts, the third ones from both ends.
    assert re.search(r"Gaussians \(%\) +\+203\.0 \[\+201\.0, \+205\.0\] +7 +7 +7 +0 +0\.01562 +0\.01562", out)
    assert not (tmp_path / "sweep/eval.json").exists()
    cells = (tmp_path / "sweep/figures/mine-minus-other-cells.csv").read_text().splitlines()
    assert len(cells) == 1 + 7
    assert cells[7].startswith("object 6,0,")
    refused = type_line("eval", "run=sweep", "arms=[mine,theirs]")
    assert refused.code == 1
    assert "arms: expected two of mine, other, got 'mine, theirs'. Try: 'arms=[mine,other]'" in refused.err
    refused = type_line("eval", "run=sweep/mine0", "arms=[mine,other]")
    assert "run: expected a sweep" in refused.err


@pytest.mark.parametrize("has_display", [True, False])
def test_view_opens_its_address_if_there_is_a_display(run_folder, type_line, monkeypatch, has_display):
    opened = []
    monkeypatch.setattr(view, "has_display", lambda: has_display)
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("cadam3d.live.server.Server.serve_forever", lambda self: None)
    code, out, _ = type_line("view", f"run={run_folder}")
    assert code == 0
    assert opened == out.splitlines()[:1] * has_display
    assert type_line("view", f"run={run_folder}", "open=false").code == 0
    assert len(opened) == has_display


def test_view_shows_the_report_of_a_sweep_and_writes_it_if_it_is_missing(tmp_path, type_line, monkeypatch):
    sweep = make_sweep(tmp_path / "sweep", "a")
    written = []

    def write(folder: Path) -> Path:
        written.append(folder)
        (folder / "report.html").touch()
        return folder / "report.html"

    monkeypatch.setattr("cadam3d.report.write_sweep", write)
    for _ in range(2):
        code, out, _ = type_line("view", "run=sweep", "open=false")
        assert code == 0
        assert "sweep/report.html" in out
    assert written == [sweep]


# --- several runs side by side -----------------------------------------------------------------------------

SIDE = ("exporter.preview.size=32", "exporter.preview.views=2", "exporter.turntable.size=32")
SIDE += ("exporter.turntable.views=3", "exporter.turntable.beside=none")


@pytest.fixture
def two_runs(tmp_path, gaussians) -> tuple[Path, Path]:
    """Return a run of 6 Gaussians and one of 2, trained by different densifiers."""
    first = make_run(tmp_path / "a, [run]", gaussians)
    second = make_run(tmp_path / "b", gaussians.index(slice(0, 2)))
    write_json(first / "summary.json", {"densifier": "baseline"})
    write_json(second / "summary.json", {"densifier": "cadam"})
    return first, second


def test_several_runs_are_one_picture_and_one_video_with_the_counts_of_their_files(
    two_runs, type_line, monkeypatch
):
    drawn = []
    draw = caption.side_by_side
    for module in ("preview", "turntable"):
        monkeypatch.setattr(
            f"cadam3d.exporter.{module}.side_by_side",
            lambda pictures, captions, paper: drawn.append(captions) or draw(pictures, captions, paper),
        )
    code, out, _ = type_line("render", "run=['a, [run]', b]", *SIDE)
    assert code == 0
    folder = two_runs[0] / "compare/b"
    assert sorted(path.name for path in folder.iterdir()) == ["preview.png", "turntable.mp4"]
    expected = [Caption("baseline", "6 Gaussians"), Caption("cadam", "2 Gaussians")]
    assert drawn == [expected] * 4
    assert "baseline: 6 Gaussians; cadam: 2 Gaussians" in out


def test_the_suffix_of_a_file_and_the_labels_of_the_user_hold_for_several_runs(two_runs, type_line, tmp_path):
    words = ("run=[b,b]", "labels=[Ours (new), the baseline]", "exporter.turntable.views=2", *SIDE[2:3])
    assert type_line("render", *words, "output=both.webm").code == 0
    assert (tmp_path / "both.webm").stat().st_size > 0


def test_runs_with_equal_densifiers_are_labelled_by_their_folders_and_equal_folders_by_their_paths(two_runs):
    first, second = two_runs
    assert default_labels([first, second]) == ["baseline", "cadam"]
    write_json(first / "summary.json", {"densifier": "cadam"})
    assert default_labels([first, second]) == ["a, [run]", "b"]
    assert default_labels([second, second]) == [str(second)] * 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run=[b]",), "run: expected 2 to 12 runs, got 1. Try: run=outputs/latest"),
        (("run=[b,nowhere]",), "run: expected the folder of a run, with a config.yaml, got 'nowhere'. Try: "),
        (
            ("run=[b,b]", "labels=[a]"),
            "labels: expected one text of 1 to 80 characters for each of the 2 runs",
        ),
        (("run=[b,b]", "labels=[a,'']"), "labels: expected one text of 1 to 80 characters"),
        (("run=[b,b]", "ply=a.ply"), "run, ply: expected one of them, got both. Try: ply=null"),
    ],
)
def test_runs_that_cannot_be_compared_are_one_message(words, message, two_runs, type_line):
    assert type_line("render", *words).message.startswith(message)
