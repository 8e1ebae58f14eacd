"""Files of prompts, and the sets that come with this package."""

import json
from collections import Counter
from pathlib import Path

import pytest
from harsh_prompts import HARSH

from cadam3d.core.errors import UserError
from cadam3d.io import prompt_files as module
from cadam3d.io.prompt_files import Prompt, read_prompts
from cadam3d.prior.shapes.grammar import parse


def texts(prompts) -> list[str]:
    return [each.text for each in prompts]


def read(tmp_path: Path, content: str | bytes, name: str = "prompts.yaml") -> tuple[Prompt, ...]:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_prompts(str(path))


FORMATS = {
    "lines.txt": "# mine\n\n" + "".join(f"  {text}\n" for text in HARSH),
    "windows.TXT": "\ufeff" + "\r\n".join(["#", *HARSH]),
    "no_suffix": "\r".join(HARSH),
    "library.json": json.dumps({"dreamfusion": HARSH}, indent=4),
    "list.json": json.dumps(HARSH, ensure_ascii=False),
    "entries.json": json.dumps([{"prompt": text} for text in HARSH]),
    "list.yaml": "\n".join(f"- {json.dumps(text, ensure_ascii=False)} # one" for text in HARSH),
    "entries.yml": "prompts:\n" + "\n".join(f"- prompt: {json.dumps(text)}" for text in HARSH[:14]),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_prompts(name, tmp_path):
    wanted = [text.strip() for text in HARSH]
    assert texts(read(tmp_path, FORMATS[name], name)) == wanted[: 14 if name == "entries.yml" else None]


def test_a_prompt_of_yaml_is_text_as_it_is_spelled(tmp_path):
    assert texts(read(tmp_path, "- 012\n- yes\n- 2026-01-01\n- >\n  two\n  lines\n")) == [
        *("012", "yes", "2026-01-01", "two lines")
    ]


def test_the_keys_of_an_entry_are_its_prompt_its_settings_and_its_labels(tmp_path):
    content = """
    - prompt: a fox of glass
      negative_prompt: blurry
      initializer_prompt: a fox
      name: fox
      category: Material
    - {prompt: a cat, negative_prompt: "", category: null}
    """
    assert read(tmp_path, content) == (
        Prompt(
            text="a fox of glass",
            settings=(("negative_prompt", "blurry"), ("initializer.prompt", "a fox")),
            name="fox",
            category="Material",
        ),
        Prompt(text="a cat", settings=(("negative_prompt", ""),)),
    )


def test_the_names_of_several_lists_are_categories(tmp_path):
    found = read(
        tmp_path, '{"Material": ["a", {"prompt": "b", "category": "other"}], "Concept": ["c"]}', "x.json"
    )
    assert [(each.text, each.category) for each in found] == [
        ("a", "Material"),
        ("b", "other"),
        ("c", "Concept"),
    ]


def test_a_repeated_prompt_counts_once(tmp_path):
    assert texts(read(tmp_path, "a cat\na dog\na cat\n", "x.txt")) == ["a cat", "a dog"]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("x.txt", b"a\n\xff\xfeb", "x.txt: expected UTF-8 text"),
        ("x.txt", "a\nb\0c", "x.txt, line 2: expected a prompt as plain text"),
        ("x.json", '["a\\u0000b"]', "x.json, entry 1: expected a prompt as plain text"),
        ("x.json", '["a", "\\ud800"]', "x.json: expected UTF-8 text, plain YAML or JSON"),
        ("x.txt", f"a\n{'x' * 10_001}", "x.txt, line 2: expected a prompt as plain text of at most 10000"),
        ("x.txt", "# only this\n", "x.txt: expected from 1 to 10000 prompts, got 0"),
        ("x.yaml", "", "expected a list of prompts, or names with lists of prompts, got None"),
        ("x.yaml", "a prompt", "x.yaml: expected a list of prompts"),
        ("x.yaml", "- a\n- [b]", "x.yaml, entry 2: expected a prompt as plain text"),
        ("x.yaml", "- a\n-\n- b", "x.yaml, entry 2: expected a prompt as plain text"),
        ("x.yaml", "- a\n- b: c", "x.yaml, entry 2: expected a prompt as plain text"),
        ("x.yaml", "- name: a", "x.yaml, entry 1: expected a prompt as plain text"),
        ("x.yaml", "- prompt: a\n- prompt: a\n  name: b", "entry 2: expected the settings that an earlier"),
        ("x.yaml", "- a\n- {prompt: b", "x.yaml: expected UTF-8 text, plain YAML or JSON"),
        ("x.yaml", "- &a b\n- *a", "an alias, *a, in line 2"),
        ("x.yaml", "- a\n- !!python/object/apply:os.getcwd []", "a tag, tag:yaml.org,2002:python/object"),
        ("x.yaml", "[" * 5000, "expected UTF-8 text, plain YAML or JSON"),
        ("x.json", '{"a": ["b", 3]}', "x.json, 'a', entry 2: expected a prompt as plain text"),
        ("x.json", "[" * 5000, "expected UTF-8 text, plain YAML or JSON"),
        ("x.json", '{"a\\u0000": ["b"], "c": ["d"]}', "entry 1: expected a prompt as plain text"),
        ("x.json", '["lib:corgi_hat"]', "x.json, entry 1: expected a prompt as plain text"),
        ("x.txt", "???", "x.txt, line 1: expected a prompt as plain text"),
        ("x.csv", "a", "suffix of x.csv: expected one of "),
    ],
)
def test_a_mistake_in_a_file_is_one_message_with_its_place(name, content, expected, tmp_path):
    with pytest.raises(UserError) as caught:
        read(tmp_path, content, name)
    message = str(caught.value)
    assert message.startswith("prompts: ")
    assert expected in message
    assert message.isprintable()


def test_files_with_too_many_prompts_and_files_that_are_too_large_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST", 2)
    with pytest.raises(UserError, match="expected from 1 to 2 prompts, got 3"):
        read(tmp_path, "a\nb\nc", "x.txt")
    monkeypatch.setattr(module, "LARGEST", 2)
    with pytest.raises(UserError, match="expected at most 2 bytes"):
        read(tmp_path, "abc", "x.txt")


def test_a_set_is_found_before_a_file_of_its_name_and_a_path_finds_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("paper50", "paper50.txt", "mine"):
        Path(name).write_text(f"{name}\n")
    assert len(read_prompts("paper50")) == 50
    assert texts(read_prompts("./paper50")) == ["paper50"]
    assert texts(read_prompts("paper50.txt")) == ["paper50.txt"]
    assert texts(read_prompts("mine")) == ["mine"]


@pytest.mark.parametrize("name", ["paper5", "paper5.txt", "/none/paper50", "x" * 5000, "a\0b"])
def test_an_unknown_name_is_answered_with_the_sets(name):
    with pytest.raises(UserError, match=r"expected a file, or one of the sets paper50\|shapes6, got"):
        read_prompts(name)


def test_the_fifty_prompts_are_balanced_and_all_different():
    prompts = read_prompts("paper50")
    assert Counter(each.category for each in prompts) == {"Material": 17, "Structure": 17, "Concept": 16}
    assert len({each.text for each in prompts}) == len({each.name for each in prompts}) == 50
    # Every first part and every shard is balanced too.
    for count in range(1, 51):
        numbers = Counter(each.category for each in prompts[:count])
        assert max(numbers.values()) - min([numbers[each.category] for each in prompts[:3]]) <= 1


def test_the_prompts_for_the_shapes_prior_can_be_read_by_it():
    prompts = read_prompts("shapes6")
    for each in prompts:
        parse(each.text)
    assert Counter(each.category for each in prompts) == {"Material": 2, "Structure": 2, "Concept": 2}
