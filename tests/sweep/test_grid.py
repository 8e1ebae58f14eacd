"""Grids: the jobs of a sweep, and the names of their folders."""

import itertools
import random

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from cadam3d.core.errors import UserError
from cadam3d.sweep.grid import Grid, expand, read_grid, read_line, sweep_name, swept_keys

PARETO = {
    "each": {"prompt": ["a lighthouse", "a torus, big"], "seed": [0, 1, 2]},
    "arms": {
        "baseline": {"densifier": "baseline", "densifier.tau_pos": [0.0003, 0.001]},
        "cadam": {"densifier": "cadam"},
    },
}
KEYS_OF = {"densifier=baseline": "densifier.tau_pos", "densifier=cadam": "densifier.tau_Q"}


@pytest.fixture
def pareto() -> Grid:
    return read_grid(PARETO)


def has_setting(overrides, key) -> bool:
    """Pretend that each densifier has a threshold of another name and that all other settings are shared."""
    return key not in KEYS_OF.values() or any(KEYS_OF.get(line) == key for line in overrides)


def values(job) -> dict[str, object]:
    parsed = OverridesParser.create().parse_overrides(list(job.overrides))
    return {override.key_or_group: override.value() for override in parsed}


def test_the_jobs_are_the_union_of_the_products_of_the_arms(pareto):
    jobs = expand(pareto, {})
    found = {(job.arm, *values(job).items()) for job in jobs}
    wanted = set()
    for prompt, seed in itertools.product(*PARETO["each"].values()):
        shared = (("prompt", prompt), ("seed", seed))
        wanted.add(("cadam", *shared, ("densifier", "cadam")))
        for tau in (0.0003, 0.001):
            wanted.add(("baseline", *shared, ("densifier", "baseline"), ("densifier.tau_pos", tau)))
    assert found == wanted
    assert len(jobs) == len(wanted)


def test_the_arms_of_one_prompt_and_seed_come_before_the_next_seed(pareto):
    jobs = expand(pareto, {})
    for number in range(0, len(jobs), 3):
        group = jobs[number : number + 3]
        assert {job.arm for job in group} == {"baseline", "cadam"}
        assert len({(values(job)["prompt"], values(job)["seed"]) for job in group}) == 1


def test_without_a_grid_the_line_is_one_product_in_its_own_order():
    jobs = expand(read_grid(None), read_line(["prompt='a cube'", "densifier=baseline,cadam", "seed=0,1"]))
    assert [(values(job)["densifier"], values(job)["seed"]) for job in jobs] == [
        ("baseline", 0),
        ("baseline", 1),
        ("cadam", 0),
        ("cadam", 1),
    ]
    assert {job.arm for job in jobs} == {""}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("seed=range(0,3)", [0, 1, 2]),
        ("seed=choice(5,7)", [5, 7]),
        ("seed=4", [4]),
        ("steps=1e3,2", [1000.0, 2]),
    ],
)
def test_the_line_replaces_an_axis_of_the_grid(pareto, line, expected):
    jobs = expand(pareto, read_line([line]))
    key = line.partition("=")[0]
    assert sorted({values(job)[key] for job in jobs}) == sorted(expected)
    assert {job.arm for job in jobs} == {"baseline", "cadam"}


def test_the_line_replaces_the_axis_of_an_arm_but_not_of_arms_without_that_setting(pareto):
    jobs = expand(pareto, read_line(["densifier.tau_pos=0.01,0.02,0.03"]), has_setting)
    assert {values(job).get("densifier.tau_pos") for job in jobs} == {0.01, 0.02, 0.03, None}
    assert len(jobs) == 6 * (3 + 1)


def test_a_setting_that_no_arm_names_goes_to_all_arms_that_have_it(pareto):
    jobs = expand(pareto, read_line(["densifier.tau_Q=0.5,0.7"]), has_setting)
    assert {(job.arm, values(job).get("densifier.tau_Q")) for job in jobs} == {
        ("baseline", None),
        ("cadam", 0.5),
        ("cadam", 0.7),
    }
    assert len(jobs) == 6 * (2 + 2)


def test_a_setting_that_no_arm_has_stays_so_that_hydra_refuses_it(pareto):
    jobs = expand(pareto, read_line(["typo=1"]), lambda overrides, key: key != "typo")
    assert all(values(job)["typo"] == 1 for job in jobs)


def test_a_setting_of_the_line_reaches_an_arm_that_does_not_name_it():
    grid = read_grid({"arms": {"paper": {"a": 1}, "strict": {"a": 2, "tau": 0.5}}})
    jobs = expand(grid, read_line(["tau=0.9"]))
    assert [values(job)["tau"] for job in jobs] == [0.9, 0.9]


def test_a_line_that_makes_two_arms_the_same_is_refused(pareto):
    with pytest.raises(
        UserError, match=r"^densifier: the arms one and two differ in this setting.*'~grid.arms.two'"
    ):
        expand(
            read_grid({"arms": {"one": {"densifier": "a"}, "two": {"densifier": "b"}}}),
            read_line(["densifier=c"]),
        )


def test_a_job_that_two_arms_share_runs_once():
    arms = {"all": {"tau": [1, 2, 3]}, "best": {"tau": 2}}
    jobs = expand(read_grid({"arms": arms}), {})
    assert [(job.arm, values(job)["tau"]) for job in jobs] == [("all", 1), ("all", 2), ("all", 3)]


def test_names_are_unique_and_valid_file_names(pareto):
    names = [job.name for job in expand(pareto, read_line(["prompt='a/b','😀','" + "x" * 300 + "'"]))]
    assert len(set(names)) == len(names) == 27
    assert all("/" not in name and len(name.encode()) < 255 for name in names)


def test_a_name_does_not_change_when_the_line_is_reordered_or_spelled_differently():
    lines = ["prompt='a cube','a ball'", "seed=0,1", "densifier.tau_Q=0.50,0.9", "steps=10"]
    rewritten = ['prompt="a ball","a cube"', "seed=range(0,2)", "densifier.tau_Q=0.9,5e-1", "steps=10"]
    names = {job.name for job in expand(read_grid(None), read_line(lines))}
    for order in itertools.permutations(rewritten):
        assert {job.name for job in expand(read_grid(None), read_line(order))} == names


def test_a_name_does_not_change_when_the_line_narrows_the_grid(pareto):
    everything = {job.name for job in expand(pareto, {})}
    for line in (["seed=1"], ["prompt='a lighthouse'", "seed=0,2"], ["densifier.tau_pos=0.001", "seed=0"]):
        narrowed = {job.name for job in expand(pareto, read_line(line), has_setting)}
        assert narrowed < everything


def test_a_name_does_not_change_when_a_setting_of_all_jobs_changes(pareto):
    """The folder of the job is then found again and its settings are compared; see test_sweeps.py."""
    before = [job.name for job in expand(pareto, read_line(["steps=100"]))]
    assert [job.name for job in expand(pareto, read_line(["steps=200"]))] == before


def test_another_prompt_on_the_line_is_another_job():
    grid = read_grid({"arms": {"one": {"densifier": "cadam"}}})
    names = {expand(grid, read_line([f"prompt='{text}'"]))[0].name for text in ("a cube", "a ball")}
    assert len(names) == 2
    assert any("a-cube" in name for name in names)


def test_the_name_of_a_sweep_is_its_grid_or_its_line_in_any_order():
    assert sweep_name("pareto", read_line(["seed=1"])) == "pareto"
    lines = ["prompt='a torus','a cube'", "densifier=a,b", "steps=5"]
    names = {sweep_name(None, read_line(order)) for order in itertools.permutations(lines)}
    assert len(names) == 1
    assert names.pop().startswith("a-torus-a-cube-densifier=a-b-steps=5_")
    assert sweep_name(None, read_line(["steps=5,6"])) != sweep_name(None, read_line(["steps=5,7"]))


def test_the_values_of_a_grid_are_unchanged_in_its_jobs():
    draw = random.Random(0)
    letters = ["\\", "'", '"', "{", ",", "(", "]", "=", " ", "a", "日", "#", "7", "."]
    texts = ["".join(draw.choices(letters, k=draw.randint(1, 8))) for _ in range(200)]
    texts += ["null", "true", "12", "cadam", "ablation/momentum"]
    others = [0, -1.5, 1e-7, True, False, None, [1, 2], ["ply", "a b"], {"a": 1, "b": [0.5]}]
    jobs = expand(read_grid({"each": {"x": [*texts, *others]}}), {})
    found = [values(job)["x"] for job in jobs]
    assert found == list(dict.fromkeys(texts)) + others
    assert [type(value) for value in found[-len(others) :]] == [type(value) for value in others]


def test_a_prompt_of_a_grid_is_text_even_if_it_looks_like_a_number():
    [job] = expand(read_grid({"each": {"prompt": 12}}), {})
    assert values(job)["prompt"] == "12"


def test_all_keys_in_which_jobs_may_differ_are_listed(pareto):
    line = read_line(["steps=5", "views=1,2", "seed=0"])
    assert swept_keys(pareto, line) == ["prompt", "seed", "densifier", "densifier.tau_pos", "views"]


@pytest.mark.parametrize(
    ("node", "key"),
    [
        ({"densifier": "baseline,cadam"}, "grid.densifier"),
        ([1], "grid"),
        ({"paper_table": "perhaps"}, "grid.paper_table"),
        ({"prompts": [1]}, "grid.prompts"),
        ({"figures": "growth"}, "grid.figures"),
        ({"arms": ["a"]}, "grid.arms"),
        ({"arms": {"a": 1}}, "grid.arms.a"),
        ({"each": {"seed": []}}, "grid.each.seed"),
    ],
)
def test_an_invalid_grid_is_refused(node, key):
    with pytest.raises(UserError, match=rf"^{key}: .*, got .* Try: "):
        read_grid(node)


@pytest.mark.parametrize(
    "value", ["interval(0,1)", "range(3,0)", "range(0,1e400)", "range(0,1,0)", "glob(*)"]
)
def test_what_is_no_list_of_values_is_refused(value):
    with pytest.raises(UserError, match=r"^seed: expected .* Try: 'seed=range"):
        read_line([f"seed={value}"])
