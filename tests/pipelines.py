"""Tiny pipelines of the real classes with random weights, saved like real ones, without any download."""

import json
from itertools import pairwise
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

WORDS = "a corgi red cube blue sphere front side back overhead view ugly blurry of the on table small big cat"
WIDTH = 32  # of every text encoder


def clip_tokenizer(folder: Path, **options):
    """Return CLIP's tokenizer with the byte alphabet and five merges, read from files like the real one."""
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPTokenizer

    folder.mkdir(parents=True, exist_ok=True)
    symbols = sorted(ByteLevel.alphabet())
    merges = ["c o", "r g", "co rg", "v i", "e w</w>"]
    pieces = [*symbols, *(symbol + "</w>" for symbol in symbols), *(m.replace(" ", "") for m in merges)]
    pieces += ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({piece: i for i, piece in enumerate(pieces)}))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges) + "\n")
    return CLIPTokenizer.from_pretrained(folder, **{"model_max_length": 77, **options})


def clip(folder: Path, seed: int = 0) -> Path:
    """Save a small CLIP model with its tokenizer and the preprocessing of its pictures."""
    from transformers import CLIPConfig, CLIPImageProcessorPil, CLIPModel

    tokenizer = clip_tokenizer(folder)
    last = len(tokenizer) - 1
    small = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    words = {"vocab_size": last + 1, "bos_token_id": last - 1, "eos_token_id": last, "pad_token_id": last}
    config = CLIPConfig(
        text_config=small | words,
        vision_config=small | {"image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = CLIPModel(config)
        # Drawn larger than usual, so that pictures and texts differ clearly.
        for parameter in model.parameters():
            parameter.data *= 4 if parameter.dim() > 1 else 1
        model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}).save_pretrained(
        folder
    )
    return folder


def t5_tokenizer():
    """Return a unigram tokenizer, trained on a dozen words."""
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers
    from transformers import T5TokenizerFast

    tokenizer = Tokenizer(models.Unigram())
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    special = ["<pad>", "</s>", "<unk>"]
    trainer = trainers.UnigramTrainer(vocab_size=80, special_tokens=special, unk_token="<unk>")
    tokenizer.train_from_iterator([WORDS] * 10, trainer)
    return T5TokenizerFast(tokenizer_object=tokenizer, extra_ids=0)


def clip_text(tokenizer, *, projected: bool = False, layers: int = 2, **options):
    """Return a CLIP text encoder, with or without the projection of its pooled output."""
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

    last = len(tokenizer) - 1
    usual = {
        "vocab_size": len(tokenizer),
        "hidden_size": WIDTH,
        "intermediate_size": 48,
        "num_hidden_layers": layers,
        "num_attention_heads": 2,
        "projection_dim": WIDTH,
        "bos_token_id": last - 1,
        "eos_token_id": last,
        "pad_token_id": last,
    }
    return (CLIPTextModelWithProjection if projected else CLIPTextModel)(CLIPTextConfig(**usual | options))


def vae(channels: int, scaling: float, shift: float | None = None, *, width: int = 8, groups: int = 4):
    """Return an image autoencoder with four blocks, which gives the real factor of eight."""
    from diffusers import AutoencoderKL

    return AutoencoderKL(
        block_out_channels=(width,) * 4,
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        latent_channels=channels,
        layers_per_block=1,
        norm_num_groups=groups,
        scaling_factor=scaling,
        shift_factor=shift,
        use_quant_conv=shift is None,
        use_post_quant_conv=shift is None,
        sample_size=64,
    )


def unet(cross: int, **options):
    """Return a UNet of two blocks with text cross-attention."""
    from diffusers import UNet2DConditionModel

    usual = {
        "sample_size": 8,
        "in_channels": 4,
        "out_channels": 4,
        "block_out_channels": (16, 32),
        "layers_per_block": 1,
        "norm_num_groups": 8,
        "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
        "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
        "cross_attention_dim": cross,
        "attention_head_dim": 8,
        "use_linear_projection": True,
    }
    return UNet2DConditionModel(**usual | options)


def ddim(prediction: str = "epsilon"):
    """Return the noise schedule of Stable Diffusion."""
    from diffusers import DDIMScheduler

    return DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=False,
        steps_offset=1,
        prediction_type=prediction,
    )


def stable_diffusion(folder: Path, prediction: str = "epsilon", tokens: int = 77) -> Path:
    """Save a small Stable Diffusion 1.5 or 2.1."""
    from diffusers import StableDiffusionPipeline

    with torch.random.fork_rng():
        torch.manual_seed(0)
        tokenizer = clip_tokenizer(folder / "tokens", model_max_length=tokens)
        StableDiffusionPipeline(
            vae=vae(4, 0.18215),
            text_encoder=clip_text(tokenizer, max_position_embeddings=tokens),
            tokenizer=tokenizer,
            unet=unet(WIDTH),
            scheduler=ddim(prediction),
            safety_checker=None,
            feature_extractor=None,
            requires_safety_checker=False,
        ).save_pretrained(folder)
    return folder


def stable_diffusion_xl(folder: Path) -> Path:
    """Save a small SDXL with two encoders, pooled text and six numbers about sizes beside the time."""
    from diffusers import StableDiffusionXLPipeline

    with torch.random.fork_rng():
        torch.manual_seed(0)
        tokenizer = clip_tokenizer(folder / "tokens")
        StableDiffusionXLPipeline(
            vae=vae(4, 0.13025),
            text_encoder=clip_text(tokenizer),
            text_encoder_2=clip_text(tokenizer, projected=True),
            tokenizer=tokenizer,
            tokenizer_2=tokenizer,
            unet=unet(
                2 * WIDTH,
                addition_embed_type="text_time",
                addition_time_embed_dim=8,
                projection_class_embeddings_input_dim=6 * 8 + WIDTH,
            ),
            scheduler=ddim(),
            force_zeros_for_empty_prompt=True,
        ).save_pretrained(folder)
    return folder


def stable_diffusion_3(folder: Path, t5: bool = True) -> Path:
    """Save a small Stable Diffusion 3 or 3.5, with or without T5."""
    from diffusers import FlowMatchEulerDiscreteScheduler, SD3Transformer2DModel, StableDiffusion3Pipeline
    from transformers import T5Config, T5EncoderModel

    joint = 2 * WIDTH
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tokenizer = clip_tokenizer(folder / "tokens")
        words = t5_tokenizer() if t5 else None
        third = None
        if words is not None:
            third = T5EncoderModel(
                T5Config(
                    vocab_size=len(words),
                    d_model=joint,
                    d_kv=8,
                    d_ff=48,
                    num_layers=2,
                    num_heads=2,
                    decoder_start_token_id=0,
                )
            )
        StableDiffusion3Pipeline(
            transformer=SD3Transformer2DModel(
                sample_size=16,
                patch_size=2,
                in_channels=16,
                num_layers=2,
                attention_head_dim=8,
                num_attention_heads=4,
                joint_attention_dim=joint,
                caption_projection_dim=32,
                pooled_projection_dim=2 * WIDTH,
                out_channels=16,
                pos_embed_max_size=96,
                qk_norm="rms_norm",
                dual_attention_layers=(0,),
            ),
            scheduler=FlowMatchEulerDiscreteScheduler(shift=3.0),
            vae=vae(16, 1.5305, 0.0609),
            text_encoder=clip_text(tokenizer, projected=True),
            tokenizer=tokenizer,
            text_encoder_2=clip_text(tokenizer, projected=True),
            tokenizer_2=tokenizer,
            text_encoder_3=third,
            tokenizer_3=words,
        ).save_pretrained(folder)
    return folder


# What the models that come with the package know, as the file of such a model lists it.
VOCABULARY = {
    "nouns": ["sphere", "cube", "torus", "cone", "star", "house", "mushroom", "car", "tree", "snowman"],
    "colours": ["red", "orange", "yellow", "green", "cyan", "blue", "white", "black", "grey"],
    "patterns": ["striped", "checkered", "spotted"],
    "relations": ["on", "next to"],
    "views": ["front", "side", "back", "overhead", "right", "left", "view", "from", "below", "above"],
    "qualities": ["ugly", "blurry", "low quality"],
    "held_out": [["red", "mushroom"]],
}


def shapes(folder: Path, kind: str) -> Path:
    """Save a small model of one of the kinds above in half precision, with the words that it knows.

    Like the models that come with the package, a Stable Diffusion reads 32 tokens.
    """
    if kind == "stable_diffusion":
        stable_diffusion(folder, "v_prediction", tokens=32)
    else:
        {"mvdream": mvdream, "stable_diffusion_3": stable_diffusion_3}[kind](folder)
    for file in folder.rglob("*.safetensors"):
        save_file({name: each.half() for name, each in load_file(file).items()}, file, {"format": "pt"})
    if kind == "mvdream":
        index = json.loads((folder / "model_index.json").read_text(encoding="utf-8"))
        text = json.dumps(index | {"_class_name": "MVDreamPipeline"})
        (folder / "model_index.json").write_text(text, encoding="utf-8")
    (folder / "vocabulary.json").write_text(json.dumps(VOCABULARY), encoding="utf-8")
    return folder


def mvdream(folder: Path) -> Path:
    """Save a small MVDream; values that its published file omits (groups, heads of 64) are as real."""
    from diffusers import StableDiffusionPipeline

    width = 64
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tokenizer = clip_tokenizer(folder / "tokens", pad_token="!")
        StableDiffusionPipeline(
            vae=vae(4, 0.18215, width=32, groups=32),
            text_encoder=clip_text(tokenizer, hidden_size=width, num_attention_heads=1, hidden_act="gelu"),
            tokenizer=tokenizer,
            unet=unet(
                width,
                block_out_channels=(width, 2 * width),
                norm_num_groups=32,
                attention_head_dim=(1, 2),
                class_embed_type="projection",
                projection_class_embeddings_input_dim=16,
            ),
            scheduler=ddim(),
            safety_checker=None,
            feature_extractor=None,
            requires_safety_checker=False,
        ).save_pretrained(folder)
    return folder


def shap_e(folder: Path, surface: bool = True) -> Path:
    """Save a small Shap-E; without a surface, its table of triangles is empty, as in a new model."""
    from diffusers import HeunDiscreteScheduler, PriorTransformer, ShapEPipeline
    from diffusers.pipelines.shap_e import ShapERenderer

    # The size of the renderer's network. Each row of its weights is one token of the latent.
    width, layers = 8, 4
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tokenizer = clip_tokenizer(folder / "tokens")
        renderer = ShapERenderer(
            param_shapes=((width, 93), *((width, width),) * (layers - 1)), d_latent=16, d_hidden=width
        )
        if surface:
            renderer.mesh_decoder.cases, renderer.mesh_decoder.masks = triangles_of_cubes()
        ShapEPipeline(
            prior=PriorTransformer(
                num_attention_heads=2,
                attention_head_dim=8,
                num_layers=2,
                embedding_dim=16,
                num_embeddings=width * layers,
                additional_embeddings=0,
                time_embed_act_fn="gelu",
                norm_in_type="layer",
                encoder_hid_proj_type=None,
                added_emb_type=None,
                time_embed_dim=16,
                embedding_proj_dim=WIDTH,
                clip_embed_dim=32,
            ),
            text_encoder=clip_text(tokenizer, projected=True),
            tokenizer=tokenizer,
            scheduler=HeunDiscreteScheduler(
                beta_schedule="exp",
                num_train_timesteps=1024,
                prediction_type="sample",
                use_karras_sigmas=True,
                clip_sample=True,
            ),
            shap_e_renderer=renderer,
        ).save_pretrained(folder)
    return folder


def triangles_of_cubes() -> tuple[torch.Tensor, torch.Tensor]:
    """Return a table for marching cubes with a fan over the cut edges of each cube, a crumpled surface.

    Bit x + 2 y + 4 z of a case is set if that corner is inside. Edges along x come first, then y, then z.
    """
    corners = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    edges = []
    for axis in range(3):
        for low in (corner for corner in corners if corner[axis] == 0):
            high = tuple(1 if i == axis else value for i, value in enumerate(low))
            edges.append((corners.index(low), corners.index(high)))
    cases, masks = torch.zeros(256, 5, 3, dtype=torch.long), torch.zeros(256, 5, dtype=torch.bool)
    for case in range(256):
        cut = [i for i, (low, high) in enumerate(edges) if (case >> low & 1) != (case >> high & 1)]
        for row, (second, third) in enumerate(list(pairwise(cut[1:]))[:5]):
            cases[case, row], masks[case, row] = torch.tensor([cut[0], second, third]), True
    return cases, masks
