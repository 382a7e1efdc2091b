"""Compile matrix: each effect, all, all but one, all pairs; source texts, and images against the reference.

Texts are assembled for all. Kernels are built, and images compared, for all effects with each lens and for a
sample of the others; `pytest -m exhaustive` runs the rest."""

import re
from itertools import combinations

import pytest
from combined import LENSES, SWITCHES, all_effects, assert_renders, combination, is_compatible
from sampling import sampled

from fidsplat.backends.opencl.assemble import assemble
from fidsplat.backends.opencl.kernel_config import cpu_config, gpu_config

BACKEND = "opencl"

SHAPES = (cpu_config(), gpu_config())
PAIRS = [pair for pair in combinations(SWITCHES, 2) if is_compatible(pair)]


def assert_well_formed(names, shapes=SHAPES):
    """All hooks are expanded, and each kernel has exactly its arguments."""
    features = combination(names).features()
    for shape in shapes:
        source = assemble(features, shape)
        assert "//" not in source.text
        assert source.text.count("{") == source.text.count("}")
        assert source.records["Splat"].itemsize % 16 == 0
        head = r"^kernel\b.*?\bvoid (\w+)\((.*?)\)\s(?:#endif\s)?\{"
        heads = dict(re.findall(head, source.text, re.MULTILINE | re.DOTALL))
        assert heads.keys() == source.arguments.keys()
        for kernel, arguments in source.arguments.items():
            lines = [line.strip(" ,") for line in heads[kernel].splitlines() if line and line[0] != "#"]
            real = source.scalar_types.blend_real
            declared = [one.text.replace("blend_real", real) for one in arguments.values()]
            assert lines == declared, kernel
        # resolve may be fused into blend
        argument_names = source.arguments.get("resolve", source.arguments["blend"]).keys()
        assert {f"{output.name}_out" for output in features.images} <= argument_names
        assert {one.name for one in source.sample_buffers} <= argument_names
        assert {one.name for one in source.sample_buffers} <= source.arguments["blend"].keys()


def test_texts_of_each_effect():
    assert len(SWITCHES) > 35
    for names in [(), *((name,) for name in SWITCHES)]:
        assert_well_formed(names)


@pytest.mark.sweep
@pytest.mark.parametrize("first", [0, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_texts_of_every_pair(first):
    """Schedules alternate."""
    for k, pair in enumerate(PAIRS, first):
        assert_well_formed(pair, [SHAPES[k % 2]])


def test_most_feature_sets_share_the_program_of_lists():
    """The driver's cache then compiles it once."""
    for shape in SHAPES:
        texts = [assemble(combination((name,)).features(), shape).programs["lists"] for name in SWITCHES]
        assert max(map(texts.count, texts)) > 0.8 * len(SWITCHES)


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_texts_of_all_effects_and_of_all_but_one(lens):
    names = all_effects(lens)
    assert_well_formed(names)
    for left_out in names:
        assert_well_formed([name for name in names if name != left_out])


# tests/contract has each effect on every device in a file of its own
@pytest.mark.parametrize("name", sampled(list(SWITCHES), 3, 12))
def test_each_single_effect(renderer, name):
    assert_renders(renderer, (name,))


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_all_effects(renderer, lens):
    assert_renders(renderer, all_effects(lens))


@pytest.mark.parametrize("left_out", sampled(all_effects("fisheye"), 1, 13))
def test_all_effects_but_one(renderer, left_out):
    assert_renders(renderer, [name for name in all_effects("fisheye") if name != left_out])


@pytest.mark.parametrize("pair", sampled(PAIRS, 5, 11), ids=" and ".join)
def test_pairs(renderer, pair):
    assert_renders(renderer, pair)
