"""``cadam3d doctor`` names the ray tracer of the embedded prior, and compares the native one with torch."""

import json
from dataclasses import asdict, replace

import pytest

from cadam3d.commands import doctor_tracer
from cadam3d.commands.doctor_tracer import TOPIC, check_tracer
from cadam3d.commands.finding import Verdict
from cadam3d.compiled import build
from cadam3d.compiled.build import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler")


@needs_compiler
def test_the_native_tracer_is_named_and_agrees_with_torch():
    finding = check_tracer()
    assert (finding.topic, finding.verdict) == (TOPIC, Verdict.OK)
    assert finding.found.startswith(
        f"native, {finding.facts['instruction_set']} by {find_compiler().version}, "
    )
    assert finding.facts["difference"] <= 1e-6
    assert json.loads(json.dumps(asdict(finding), allow_nan=False))


@needs_compiler
def test_a_native_tracer_that_draws_something_else_is_broken(monkeypatch):
    trace = doctor_tracer.trace_natively

    def brighter(*case):
        layers = trace(*case)
        return replace(layers, paints=1.01 * layers.paints)

    monkeypatch.setattr(doctor_tracer, "trace_natively", brighter)
    finding = check_tracer()
    assert finding.verdict is Verdict.BROKEN
    assert finding.hint.endswith("use prior.tracer=torch")


def test_without_a_compiler_the_tracer_in_torch_is_named_with_the_reason(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build, "find_compiler", lambda: None)
    finding = check_tracer()
    assert finding.verdict is Verdict.NOTE
    assert finding.found.startswith("torch, which is slow: prior.tracer=native: expected a C++ compiler")
    assert finding.facts == {"tracer": "torch"}
