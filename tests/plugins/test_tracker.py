"""Laws of the tracker: the arithmetic of ``densifier=cadam``, held for a trainer that is not ours."""

import ast
import io
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from composed import composed
from evidence import CPU, DRAWS, STEP, edit_of, noise, signal

import cadam3d
from cadam3d.build import component
from cadam3d.core.errors import UserError
from cadam3d.densifier.cadam import CAdam
from cadam3d.plugins import CAdamTracker, reset_opacities
from cadam3d.plugins.tracker import CAdamSettings

PACKAGE = Path(cadam3d.__file__).parent
N = 12
YOUNG = {"min_age": 0, "reset_min_age": 0}


def tracker_of(gradients: torch.Tensor, **settings) -> CAdamTracker:
    """Return a tracker that has observed ``gradients`` [steps n 3]."""
    tracker = CAdamTracker(torch.zeros(gradients.shape[1], 3), **{**YOUNG, **settings})
    for gradient in gradients:
        tracker.observe(gradient)
    return tracker


def cadam_of(tracker: CAdamTracker):
    """Return what ``densifier=cadam`` decides about the state of a tracker."""
    densifier = CAdam(**{each.name: getattr(tracker, each.name) for each in fields(CAdam)})
    return densifier, densifier.select(tracker.state, STEP, DRAWS), densifier.unreliable(tracker.state)


def test_the_defaults_are_those_of_the_yaml_file():
    published = component(composed("prompt=a cube", "refine.interval=100").densifier)
    assert CAdamTracker(torch.zeros(1, 3)).cadam() == published
    names = {each.name for each in fields(CAdamSettings)} | {"reset_min_age"}
    assert names == {each.name for each in fields(CAdam)}


def test_moments_are_those_of_the_densifier_to_the_bit():
    gradients = noise(30, N) * torch.logspace(-9, 3, 30)[:, None, None]
    tracker = tracker_of(gradients)
    densifier, selected, unreliable = cadam_of(tracker)
    state = densifier.init_state(N, CPU)
    for gradient in gradients:
        state = densifier.observe(state, signal(gradient))
    for name, rows in tracker.state_dict().items():
        assert torch.equal(rows, getattr(state, name))
    assert torch.equal(tracker.select(), selected)
    assert torch.equal(tracker.unreliable(), unreliable)
    assert selected.any()
    assert not selected.all()


def test_of_the_selected_at_most_so_many_grow_which_have_the_largest_drifts():
    tracker = tracker_of(noise(30, N), tau_Q=0.3)
    selected = tracker.select()
    best = torch.where(selected, tracker.scores()["drift"], 0.0).argsort(descending=True)
    for most in (0, 1, int(selected.sum()) - 1):
        assert tracker.select(most).nonzero()[:, 0].tolist() == sorted(best[:most].tolist())
    assert torch.equal(tracker.select(N), selected)
    assert not tracker.select(-1).any()


def test_survivors_keep_their_history_and_newborns_start_at_zero_with_age_zero():
    tracker = tracker_of(noise(9, 5))
    # Clone the rows 1 and 4, then remove 0 and 4, as the densifier does it in one edit.
    expected = tracker.state.carry(edit_of(5, keep=[1, 2, 3], parents=[1, 4]))
    tracker.append(2)
    tracker.keep(torch.tensor([False, True, True, True, False, True, True]))
    for name, rows in tracker.state_dict().items():
        assert torch.equal(rows, getattr(expected, name))
    assert tracker.state.age.tolist() == [9, 9, 9, 0, 0]


def test_a_child_can_take_the_place_of_its_parent():
    tracker = tracker_of(noise(9, 3))
    before = tracker.state.m
    tracker.follow(torch.tensor([2, -1, 0, -1]))
    assert tracker.state.age.tolist() == [9, 0, 9, 0]
    assert torch.equal(tracker.state.m[[0, 2]], before[[2, 0]])
    assert not tracker.state.m[[1, 3]].any()
    assert len(tracker) == 4


@pytest.mark.parametrize(
    "convert",
    [torch.Tensor.to_sparse, lambda gradient: gradient.to_sparse(1), torch.Tensor.double],
    ids=["sparse", "sparse rows", "double"],
)
def test_the_format_of_the_gradient_does_not_matter(convert):
    gradients = noise(5, N) * (torch.arange(N) % 3 > 0)[:, None]
    tracker = tracker_of(gradients)
    other = CAdamTracker(torch.zeros(N, 3))
    for gradient in gradients:
        other.observe(convert(gradient))
    assert torch.equal(tracker.state.m, other.state.m)
    assert torch.equal(tracker.state.v, other.state.v)


def test_a_tracker_from_a_checkpoint_continues_to_the_bit():
    gradients = noise(20, N)
    whole, first = tracker_of(gradients), tracker_of(gradients[:8])
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    resumed = CAdamTracker(torch.zeros(1, 3), **YOUNG)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for gradient in gradients[8:]:
        resumed.observe(gradient)
    assert all(torch.equal(rows, getattr(whole.state, name)) for name, rows in resumed.state_dict().items())


MISTAKES = {
    "no gradient": (lambda tracker: tracker.observe(None), "observe: .*got None"),
    "rows added": (lambda tracker: tracker.observe(torch.zeros(N + 2, 3)), r"shape \(12, 3\).*got \(14, 3\)"),
    "rows removed": (lambda tracker: tracker.observe(torch.zeros(4, 3)), r"Try: .*tracker\.keep\(mask\)$"),
    "screen": (lambda tracker: tracker.observe(torch.zeros(N, 2)), r"shape \(12, 3\).*got \(12, 2\)"),
    "a number": (lambda tracker: tracker.observe(torch.tensor(1.0)), r"shape \(12, 3\).*got \(\)"),
    "short mask": (
        lambda tracker: tracker.keep(torch.ones(3, dtype=torch.bool)),
        "keep: expected a mask of 12",
    ),
    "no such row": (lambda tracker: tracker.follow(torch.tensor([0, N])), "follow: .*from -1 to 11, got"),
    "below": (lambda tracker: tracker.follow(torch.tensor([0, -2])), "follow: .*from -1 to 11, got"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_changes_nothing_and_names_the_remedy(mistake):
    call, message = MISTAKES[mistake]
    tracker = tracker_of(noise(5, N))
    before = tracker.state
    with pytest.raises(UserError, match=message):
        call(tracker)
    assert tracker.state is before


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
def test_only_the_chosen_opacities_are_reset_and_lose_their_moments(shape):
    logits = torch.tensor([3.0, 2.0, -9.0, 1.0]).view(shape).requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=0.0)
    logits.square().sum().backward()
    optimizer.step()
    before = {name: rows.clone() for name, rows in optimizer.state[logits].items()}
    rows = torch.tensor([True, False, True, False])
    assert reset_opacities(logits, rows, optimizer, 0.01) == 1
    assert logits.flatten().sigmoid().tolist() == pytest.approx([0.01, 0.8808, 0.0001234, 0.7311], rel=0.01)
    for name in ("exp_avg", "exp_avg_sq"):
        moment = optimizer.state[logits][name].flatten()
        assert not moment[rows].any()
        assert torch.equal(moment[~rows], before[name].flatten()[~rows])
    assert optimizer.state[logits]["step"] == 1
    optimizer.param_groups[0]["lr"] = 1.0
    optimizer.step()
    assert float(logits.detach().flatten().sigmoid()[0]) == pytest.approx(0.01)


def imported_by(module: Path) -> set[str]:
    """Return the foreign packages that an import of ``module`` loads, directly or through our files."""
    seen, ahead, foreign = set(), [module], set()
    while ahead:
        path = ahead.pop()
        seen.add(path)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inside = {
            id(each)
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            for each in ast.walk(node)
        }
        for node in ast.walk(tree):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names if id(node) not in inside else []:
                parts = name.split(".")
                if parts[0] != "cadam3d":
                    foreign.add(parts[0])
                    continue
                folders = [PACKAGE.joinpath(*parts[1:count]) for count in range(1, len(parts) + 1)]
                files = [
                    *(folder / "__init__.py" for folder in folders),
                    *(f.with_suffix(".py") for f in folders),
                ]
                ahead += [file for file in files if file.is_file() and file not in seen]
    return foreign


def test_an_import_of_the_plugins_loads_no_package_of_the_command_line():
    light = {
        "torch",
        "jaxtyping",
        "abc",
        "bisect",
        "collections",
        "dataclasses",
        "difflib",
        "functools",
        "importlib",
        "math",
        "numpy",
        "sys",
        "types",
        "typing",
    }
    assert imported_by(PACKAGE / "plugins/__init__.py") <= light
    assert imported_by(PACKAGE / "plugins/gsplat.py") <= light | {"gsplat", "warnings", "weakref"}
    assert "omegaconf" in imported_by(PACKAGE / "settings/compose.py")
