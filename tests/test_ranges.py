"""Values beyond the range of a setting are refused by name, in components that draw, guide or watch."""

import re

import pytest
import yaml
from composed import composed
from omegaconf import OmegaConf

from cadam3d.build import component
from cadam3d.core.errors import UserError

GUIDED = "scale=-1 weight=0 reduction=max t_max=0.01 t_max=1.1 weighting=sds clip=0"
# Of each option, settings with a value just beyond their range, or of another kind.
BEYOND = {
    "camera=orbit": "size=0 azimuth_deg=[90,-90] azimuth_deg=[0] elevation_deg=[-100,0] "
    "elevation_law=gaussian distance=[0.5,3] fov_y_deg=[0,45] fov_y_deg=[45,180] fov_y_deg=[45,.nan]",
    # The first of the distances is inside the unit ball at 60 degrees.
    "camera=multiview": "size=0 elevation_deg=[30,0] elevation_law=gaussian relative_distance=[0.1,1] "
    "relative_distance=[1] fov_y_deg=[0,60]",
    "camera=sphere": "size=0 distance=[3,2] fov_y_deg=[45,175]",
    "camera=progressive": "size=0 distance.start=[0.5,3] distance.end=[9,8] fov_y_deg.end=[0,30] "
    "azimuth_deg.start=[0] elevation_deg.end=[-100,0] fov_y_deg.factor=[0,1] fov_y_deg.factor=[0.75] "
    "begin=-1 every=0 gamma=0 position_jitter=-0.1 target_jitter=-0.1 up_jitter=2",
    "guidance=sds": GUIDED,
    "guidance=vfds": GUIDED,
    "guidance=csd": "weight=0 reduction=max t_max=1.1 weighting=sds clip=0 empty_share=-0.1 empty_share=1.1",
    "guidance=ism": f"{GUIDED} delta=0 delta=1.5 inversion_stride=0 inversion_stride=2 initial_noise=-0.1 "
    "initial_noise=1 noise_offset=-0.1",
    "guidance=sdi": f"{GUIDED} inversion_scale=.nan inversion_grid=sigma inversion_stride=0 "
    "inversion_stride=1.5 overshoot=-0.1 overshoot=1 eta=-0.3",
    "guidance=ucm": f"{GUIDED} inversion_steps=0 inversion_steps=2.5 inversion_grid=linear fresh_noise=-0.1 "
    "fresh_noise=1.1",
    "guidance=gcs": "scale=-1 weight=0 reduction=max t_max=1.1 w_cc=-1 w_gc=null w_cp=much delta=0.01 "
    "delta=0.6 fixed_noise=yes_ noise_offset=-0.1",
    "initializer=ball": "count=0 radius=0 radius=1.5 scale=0 opacity=1 sh_degree=4 color=[0.5,0.5] "
    "color_noise=-0.1",
    "initializer=mesh": "up=x turn_deg=45 radius=2 count=0 opacity=0 color=[1]",
    "initializer=shap_e": "ids=openai/shap-e dtype=half steps=0 guidance_scale=0.5 grid_size=1 "
    "turn_deg=45 radius=2 factor=0 lift=2 tone=dark color=[2,0,0] replicate_law=shell scale_law=median "
    "count=0 grow_points=-1 grow_distance=0 grow_noise=2 replicate=0 scale=0 sh_degree=4",
    "callback=checkpoint": "every=0 keep=0",
    "callback=metrics": "every=0",
    "callback=candidates": "every=0 azimuths_deg=[] elevation_deg=100 distance=0 size=0 bins_per_decade=0",
    "callback=previews": "every=0 views=0 elevation_deg=100 distance=0 fov_y_deg=180 size=0 "
    "background=[2,0,0]",
    "callback=progress": "refresh_seconds=-1 refresh_seconds=.nan line_seconds=.inf line_seconds=true",
    "callback=snapshots": "every=0 largest=-1",
    "prior=shapes": "spread=-0.1 edge_spread=.nan model_error=-1 samples_per_pixel=0 census_size=1 seed=-1 "
    "noise_path.train_steps=0 noise_path.beta_start=0 noise_path.beta_end=0.0001",
    "prior=shapes_flow": "noise_path.shift=0 noise_path.shift=.nan",
    "prior=tiny": "predicts=clean width=20 width=64 downscale=0 seed=-1",
    "prior=stable_diffusion": "size=100 size=0 dtype=int8 micro_batch=0 text_device=moon noise_levels=whole",
    "prior=sdxl": "vae_dtype=float16",
    "prior=mvdream": "micro_batch=1 micro_batch=6 rescale=1.5 rescale=-0.1",
    "prompting=discrete": "back_deg=170 front_deg=-1",
    "prompting=compass": "below_deg=-91 above_deg=-30",
    "prompting=perp_neg": "curve=other overhead_deg=100",
    "truth=shapes": "samples_per_pixel=0 turns=1 turns=73",
}
CASES = [(option, word) for option, words in BEYOND.items() for word in words.split()]


@pytest.mark.parametrize(("option", "word"), CASES)
def test_a_value_beyond_its_range_is_refused_by_name(option, word):
    group, name = option.split("=")
    key, text = word.split("=")
    place = f"callback.{name}" if group == "callback" else group
    cfg = composed("prompt=a", f"callback=[{name}]" if group == "callback" else option)
    node = OmegaConf.select(cfg, place).copy()
    if OmegaConf.is_missing(node, "path"):
        node.path = "a.ply"
    OmegaConf.update(node, key, yaml.safe_load(text))
    with pytest.raises(UserError, match=f"^{re.escape(f'{place}.{key}')}: expected "):
        component(node, key=place)
