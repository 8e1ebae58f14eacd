"""The files that callbacks write into the run folder."""

import torch

from cadam3d.callback.checkpoint import Checkpoint
from cadam3d.callback.metrics import Metrics
from cadam3d.io.checkpoint import latest_checkpoint, load_checkpoint
from cadam3d.io.jsonl import append_jsonl, read_jsonl
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.state import Outcome


def test_checkpoints_appear_at_multiples_and_at_the_end_and_old_ones_are_deleted(train, tmp_path):
    state, _ = train(tmp_path, callbacks=[Checkpoint(every=2, keep=2)])
    folder = tmp_path / "checkpoints"
    assert sorted(path.name for path in folder.iterdir()) == ["step_0000006.pt", "step_0000007.pt"]
    newest = latest_checkpoint(folder, load_checkpoint, lambda error: None)[1]
    assert newest["step"] == state.step == 7
    assert torch.equal(newest["gaussians"]["means"], state.gaussians.means)


def test_a_checkpoint_at_the_last_step_is_not_written_twice(train, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        "cadam3d.callback.checkpoint.save_checkpoint", lambda path, _: written.append(path.name)
    )
    train(tmp_path, "steps=4", callbacks=[Checkpoint(every=2, keep=9)])
    assert written == ["step_0000002.pt", "step_0000004.pt"]


def test_after_running_out_of_memory_the_last_checkpoint_stays(train, tmp_path, monkeypatch):
    calls = iter(range(100))

    def exhausted(self, *args, real=ReferenceRasterizer.render):
        if next(calls) == 5:
            raise MemoryError
        return real(self, *args)

    monkeypatch.setattr(ReferenceRasterizer, "render", exhausted)
    _, outcome = train(tmp_path, callbacks=[Checkpoint(every=2, keep=9)])
    assert outcome is Outcome.OUT_OF_MEMORY
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["step_0000002.pt", "step_0000004.pt"]


def test_metrics_have_one_line_per_logged_step_and_per_refinement(train, tmp_path):
    """Lines of steps that will be repeated are deleted."""
    for step in (1, 2, 3):
        append_jsonl(tmp_path / "metrics.jsonl", {"kind": "step", "step": step, "old": True})
    train(tmp_path, "refine.interval=3", callbacks=[Metrics(every=3)])
    lines = read_jsonl(tmp_path / "metrics.jsonl")
    assert [(line["kind"], line["step"]) for line in lines] == [
        ("step", 1),
        ("refine", 3),
        ("step", 3),
        ("refine", 6),
        ("step", 6),
        ("step", 7),
    ]
    refinement = lines[1]
    assert {
        "before",
        "after",
        "selected",
        "cloned",
        "split",
        "pruned",
        "reset",
        "statistics",
    } <= refinement.keys()
    assert {"loss", "num_gaussians", "seconds"} <= lines[0].keys()
