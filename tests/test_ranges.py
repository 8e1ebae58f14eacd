"""Values beyond the range of a setting are refused by name, in components that draw, guide or watch."""

import re

import pytest
import yaml
from composed import composed
from omegaconf import OmegaConf

from cadam3d.build import component
from cadam3d.core.errors import UserError

# Of some options, settings with a value beyond its range: examples, and bounds that depend on other settings.
# ``test_wrong_values.py`` goes beyond all bounds that a class declares.
BEYOND = {
    # The first of the distances is inside the unit ball at 60 degrees.
    "camera=multiview": "relative_distance=[0.1,1] elevation_law=gaussian size=0",
    "camera=progressive": "distance.start=[0.5,3] distance.end=[9,8] fov_y_deg.end=[0,30] "
    "azimuth_deg.start=[0] elevation_deg.end=[-100,0] fov_y_deg.factor=[0,1] fov_y_deg.factor=[0.75]",
    "guidance=sds": "t_max=0.01 t_max=1.1 clip=0",
    "guidance=gcs": "t_max=1.1 w_gc=null w_cp=much delta=0.01 fixed_noise=yes_",
    "callback=candidates": "azimuths_deg=[]",
    "callback=progress": "refresh_seconds=.nan line_seconds=.inf line_seconds=true",
    "prior=shapes": "spread=-0.1 edge_spread=.nan model_error=-1 samples_per_pixel=0 census_size=1 seed=-1 "
    "noise_path.train_steps=0 noise_path.beta_start=0 noise_path.beta_end=0.0001",
    "prior=shapes_flow": "noise_path.shift=0 noise_path.shift=.nan",
    "prior=stable_diffusion": "size=100 size=0 micro_batch=0",
    "prior=mvdream": "micro_batch=6",
    "prompting=discrete": "back_deg=170",
    "prompting=compass": "above_deg=-30",
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
