"""The check of ``cadam3d doctor`` for the ray tracer that draws the images of the embedded prior."""

import torch

from cadam3d.commands.doctor_rasterizers import kept, when
from cadam3d.commands.finding import Finding, Verdict, attempt
from cadam3d.compiled.build import find_compiler
from cadam3d.core.cameras import turntable
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.native_tracer import instruction_set, load_tracer, trace_natively
from cadam3d.prior.shapes.scene import build
from cadam3d.prior.shapes.tracer import trace

TOPIC = "prior.tracer=auto"
# Several kinds of solids. There is no pattern, because its borders may differ by a sample.
PROMPT = "a red mug next to a tree"
TOLERANCE = 1e-4  # of the light, in [0, 1]


def check_tracer() -> Finding:
    """Compile the native tracer and compare it with the one in torch; a note if it cannot be compiled."""
    return attempt(TOPIC, _check)


def _check() -> Finding:
    try:
        built, library = load_tracer()
    except UserError as error:
        first, *others = str(error).splitlines()
        found = f"torch, which is slow: {first}"
        return Finding(TOPIC, Verdict.NOTE, found, others[-1] if others else "", {"tracer": "torch"})
    scene = build(PROMPT).to(torch.device("cpu"), torch.float32)
    views = turntable(2, elevation_deg=20.0, distance=3.0, fov_y_deg=40.0, size=32)
    ours, expected = trace_natively(library, scene, views, 2), trace(scene, views, 2)
    difference = float((ours.paints - expected.paints).abs().max())
    compiler, instructions = find_compiler(), instruction_set(library)
    version = compiler.version if compiler else None
    facts = {"tracer": "native", "compiler": version, "instruction_set": instructions}
    facts |= {"difference": difference, **kept(built)}
    found = f"native, {instructions} by {version or 'a compiler that was removed'}, {when(built)}"
    if difference <= TOLERANCE:
        return Finding(TOPIC, Verdict.OK, f"{found}; equals torch to {difference:.1g}", facts=facts)
    hint = "Please report this. Until it is fixed, use prior.tracer=torch"
    return Finding(TOPIC, Verdict.BROKEN, f"{found}; differs from torch by {difference:.1g}", hint, facts)
