"""The compile matrix: each effect alone, all, all but one, all pairs; their texts, and pictures against the reference.

Texts are put together for all pairs; kernels are built, and pictures compared, for a sample of them, or for all of them with
FIDSPLAT_ALL_PAIRS=1 in the environment."""

import os
import re
from itertools import combinations

import numpy as np
import pytest
from combined import LENSES, SWITCHES, assert_drawn, combination, everything, goes

from fidsplat.backends.opencl.assemble import DeviceShape, assemble

BACKEND = "opencl"

SHAPES = {
    "lanes": DeviceShape("lanes", "ordered", 16, 16, 16, 8, 11, 1, True),
    "group": DeviceShape("group", "tiled", 1, 16, 16, 1024, 8, 1024, True),
}
PAIRS = [pair for pair in combinations(SWITCHES, 2) if goes(pair)]
SAMPLE = [PAIRS[k] for k in np.random.default_rng(11).choice(len(PAIRS), 12, replace=False)]
DRAWN = PAIRS if os.environ.get("FIDSPLAT_ALL_PAIRS") else SAMPLE


def parameters(text, kernel):
    """How many arguments a kernel takes."""
    found = re.search(rf"kernel [^;{{]*?\b{kernel}\((.*?)\)\s*\{{", text, re.DOTALL)
    assert found, kernel
    return found[1].count(",") + 1


def assert_well_formed(names):
    """Every hook is filled, and the kernels take what the host gives them."""
    features = combination(names).features()
    for shape in SHAPES.values():
        source = assemble(features, shape)
        assert "//" not in source.text
        assert source.text.count("{") == source.text.count("}")
        assert source.record_bytes % 16 == 0
        effects = features.effects
        planes = sum(len(effect.planes) for effect in effects)
        given = sum(len(effect.resolve_arrays) + len(effect.resolve_inputs) for effect in effects)
        arrays = given + planes + sum(effect.output is not None for effect in effects)
        pointers = re.search(r"kernel void resolve\((.*?)\)\s*\{", source.text, re.DOTALL)[1].count("global ")
        assert pointers == 2 + arrays, names
        extra = sum(len(effect.blend_inputs) for effect in effects) + planes
        blend = re.search(r"void blend\((.*?)\)\s*\{", source.text, re.DOTALL)[1]
        assert blend.count("global ") == 4 + extra, names
        project = parameters(source.text, "project")
        assert project == 13 + sum(len(effect.inputs) for effect in effects), names


def test_texts_of_each_effect_and_of_every_pair():
    assert len(SWITCHES) > 35
    for names in [(), *((name,) for name in SWITCHES), *PAIRS]:
        assert_well_formed(names)


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_texts_of_all_effects_and_of_all_but_one(lens):
    names = everything(lens)
    assert_well_formed(names)
    for left_out in names:
        assert_well_formed([name for name in names if name != left_out])


@pytest.mark.parametrize("name", SWITCHES)
def test_each_effect_alone(renderer, name):
    assert_drawn(renderer, (name,))


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_all_effects(renderer, lens):
    assert_drawn(renderer, everything(lens))


@pytest.mark.parametrize("left_out", everything("fisheye"))
def test_all_effects_but_one(renderer, left_out):
    assert_drawn(renderer, [name for name in everything("fisheye") if name != left_out])


@pytest.mark.parametrize("pair", DRAWN, ids=" and ".join)
def test_pairs(renderer, pair):
    assert_drawn(renderer, pair)
