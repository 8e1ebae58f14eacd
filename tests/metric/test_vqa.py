"""Vqa: the probability of yes by plain calls of transformers, on a small random LLaVA."""

import json
import shutil

import pytest
import torch
from PIL import Image
from protocols import output, ring
from splats import make_gaussians

from cadam3d.core.errors import UserError
from cadam3d.metric.base import Measurand
from cadam3d.metric.vqa import Vqa

# All spellings of yes and no that count, and words that only begin like them.
YES, NO = ["Yes", "yes", "▁Yes", "ĠYES"], ["No", "▁no"]
OTHERS = ["yesterday", "not", "▁", "USER", "ASSISTANT", "Does", "this", "figure", "show", "Please", "answer"]
SPECIAL = ["<unk>", "<s>", "</s>", "<pad>", "<image>"]
VOCABULARY = SPECIAL + YES + NO + OTHERS + ["or", "a", "red", "cube", "?", ".", ":", '"']
CHAT = (
    "{% for message in messages %}USER: {% for item in message['content'] %}"
    "{% if item['type'] == 'image' %}<image>{% else %} {{ item['text'] }}{% endif %}"
    "{% endfor %}{% endfor %}{% if add_generation_prompt %} ASSISTANT:{% endif %}"
)
QUESTION = 'Does this figure show "{}"? Please answer yes or no.'
PROTOCOL = ring(text="a {}", models={"vqa": "llava-hf/llava-1.5-7b-hf"})
PICTURES = torch.rand(3, 32, 32, 3, generator=torch.Generator().manual_seed(0)).round()


def render(cameras, background):
    return output(PICTURES)


MEASURAND = Measurand(gaussians=make_gaussians(2), render=render, prompt="red cube")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import (
        CLIPImageProcessorPil,
        CLIPVisionConfig,
        LlamaConfig,
        LlavaConfig,
        LlavaForConditionalGeneration,
        LlavaProcessor,
        PreTrainedTokenizerFast,
    )

    path = tmp_path_factory.mktemp("models") / "llava"
    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(VOCABULARY)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>", "pad_token": "<pad>"}
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=words, additional_special_tokens=["<image>"], **special
    )
    small = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    config = LlavaConfig(
        vision_config=CLIPVisionConfig(**small, image_size=32, patch_size=8),
        text_config=LlamaConfig(**small, vocab_size=len(VOCABULARY), max_position_embeddings=128),
        image_token_index=VOCABULARY.index("<image>"),
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = LlavaForConditionalGeneration(config)
        # Drawn larger than usual, so that the answers to pictures differ clearly.
        for parameter in model.parameters():
            parameter.data *= 8 if parameter.dim() > 1 else 1
    model.save_pretrained(path)
    pictures = CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32})
    LlavaProcessor(
        pictures,
        tokenizer,
        patch_size=8,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        image_token="<image>",
        chat_template=CHAT,
    ).save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def shares(folder):
    """Return the probabilities of all tokens after a prompt, one row per picture, by plain calls."""
    from transformers import LlavaForConditionalGeneration, LlavaProcessor

    model = LlavaForConditionalGeneration.from_pretrained(folder, dtype=torch.float32).eval()
    processor = LlavaProcessor.from_pretrained(folder)

    def after(prompt):
        rows = []
        for picture in (PICTURES * 255).byte().numpy():
            inputs = processor(images=Image.fromarray(picture), text=prompt, return_tensors="pt")
            with torch.no_grad():
                rows.append(model(**inputs).logits[0, -1].softmax(dim=-1))
        return torch.stack(rows)

    return after


def metric(folder, **changes):
    settings = {"protocol": PROTOCOL, "model": str(folder), "question": QUESTION}
    return Vqa(**settings | {"dtype": "float32"} | changes)


def columns(words):
    return [VOCABULARY.index(word) for word in words]


CHATTED = 'USER: <image> Does this figure show "a red cube"? Please answer yes or no. ASSISTANT:'


def test_the_number_is_the_probability_of_all_spellings_of_yes(folder, shares):
    measured = metric(folder).measure(MEASURAND)
    expected = shares(CHATTED)[:, columns(YES)].sum(dim=1)
    record = measured.details["vqa"]
    assert record["views"] == pytest.approx(expected.tolist(), abs=1e-5)
    assert measured.numbers["vqa"] == pytest.approx(expected.mean().item(), abs=1e-5)
    assert expected.std() > 1e-3
    assert record["yes_tokens"] == YES
    assert record["question"] == QUESTION
    assert record["text"] == "a red cube"
    assert json.loads(json.dumps(record)) == record


def test_the_question_can_be_replaced(folder, shares):
    found = metric(folder, question="Does this show {}?").measure(MEASURAND).details["vqa"]["views"]
    expected = shares("USER: <image> Does this show a red cube? ASSISTANT:")[:, columns(YES)].sum(dim=1)
    assert found == pytest.approx(expected.tolist(), abs=1e-5)


def test_a_model_without_a_chat_template_is_refused(folder, tmp_path):
    bare = shutil.copytree(folder, tmp_path / "bare")
    (bare / "chat_template.jinja").unlink()
    with pytest.raises(UserError, match="it has no chat template"):
        metric(bare).prepare()
