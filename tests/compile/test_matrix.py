"""The compile matrix: each effect alone, all, all but one, all pairs; their texts, and pictures against the
reference.

Texts are put together for all; kernels are built, and pictures compared, of all effects behind each lens and
of a sample of the others: `pytest -m exhaustive` does the rest."""

import re
from itertools import combinations

import pytest
from combined import LENSES, SWITCHES, assert_drawn, combination, everything, goes
from sampling import sampled

from fidsplat.backends.opencl.assemble import assemble
from fidsplat.backends.opencl.shapes import cpu_shape, gpu_shape

BACKEND = "opencl"

SHAPES = (cpu_shape(), gpu_shape())
PAIRS = [pair for pair in combinations(SWITCHES, 2) if goes(pair)]


def assert_well_formed(names, shapes=SHAPES):
    """Every hook is filled, and every kernel has its arguments and no other."""
    features = combination(names).features()
    for shape in shapes:
        source = assemble(features, shape)
        assert "//" not in source.text
        assert source.text.count("{") == source.text.count("}")
        assert source.records["Splat"].itemsize % 16 == 0
        heads = dict(
            re.findall(r"^kernel\b.*?\bvoid (\w+)\((.*?)\) \{", source.text, re.MULTILINE | re.DOTALL)
        )
        assert heads.keys() == source.arguments.keys()
        for kernel, arguments in source.arguments.items():
            lines = [line.strip(" ,") for line in heads[kernel].splitlines() if line and line[0] != "#"]
            declared = [one.text.replace("wide", source.scalars.wide) for one in arguments]
            assert lines == declared, kernel
        # GPUs resolve as they blend
        taken = {one.name for one in source.arguments.get("resolve", source.arguments["blend"])}
        assert {f"{output.name}_out" for output in features.images} <= taken
        assert {one.name for one, _ in source.samples} <= taken
        assert {one.name for one, _ in source.samples} <= {one.name for one in source.arguments["blend"]}


def test_texts_of_each_effect():
    assert len(SWITCHES) > 35
    for names in [(), *((name,) for name in SWITCHES)]:
        assert_well_formed(names)


@pytest.mark.parametrize("first", [0, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_texts_of_every_pair(first):
    """For one schedule and the other by turns."""
    for k, pair in enumerate(PAIRS, first):
        assert_well_formed(pair, [SHAPES[k % 2]])


def test_most_pictures_list_their_splats_by_the_same_program():
    """What a driver keeps by its text is compiled once for all of them."""
    for shape in SHAPES:
        texts = [assemble(combination((name,)).features(), shape).programs["lists"] for name in SWITCHES]
        assert max(map(texts.count, texts)) > 0.8 * len(SWITCHES)


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_texts_of_all_effects_and_of_all_but_one(lens):
    names = everything(lens)
    assert_well_formed(names)
    for left_out in names:
        assert_well_formed([name for name in names if name != left_out])


# tests/contract has each alone on every device: lenses, shutters, sensors ... in files of their own
@pytest.mark.parametrize("name", sampled(list(SWITCHES), 3, 12))
def test_each_effect_alone(renderer, name):
    assert_drawn(renderer, (name,))


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_all_effects(renderer, lens):
    assert_drawn(renderer, everything(lens))


@pytest.mark.parametrize("left_out", sampled(everything("fisheye"), 1, 13))
def test_all_effects_but_one(renderer, left_out):
    assert_drawn(renderer, [name for name in everything("fisheye") if name != left_out])


@pytest.mark.parametrize("pair", sampled(PAIRS, 5, 11), ids=" and ".join)
def test_pairs(renderer, pair):
    assert_drawn(renderer, pair)
