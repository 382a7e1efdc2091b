"""Fuzzing: distribution of the scenes, short runs, and stopped runs that resume."""

import json

import numpy as np
import pytest

from fidsplat.selftest import fuzz
from fidsplat.splats.rotations import quaternion_to_matrix


@pytest.mark.parametrize("splats", [2000, pytest.param(50_000, marks=pytest.mark.exhaustive)])
def test_a_number_of_splats(renderer, splats):
    *_, state = fuzz.fuzz_run(renderer, splats)
    assert state.failing == []
    assert state.passed
    assert state.splats >= splats
    assert set(state.largest) == {"rgb", "alpha", "depth", "depth_median", "normal", "label"}
    assert state.beyond_bound["rgb"][0] <= 2e-5


@pytest.mark.parametrize("seed", [12, 45, 68, 94, 174, 194, 223, 229, 248])
def test_seeds_that_failed_once(renderer, seed):
    """Tiny splats misjudged as edge-on; opacities at the cut-off in depth and labels; high optical depth."""
    state = fuzz.FuzzState("")
    state.add(seed, renderer)
    assert state.failing == []


@pytest.mark.parametrize("seed", [56, 107, 739])
def test_seeds_with_ties(renderer, seed):
    """Coplanar splats: terminated in one order only; tilted; fronto-parallel."""
    state = fuzz.FuzzState("")
    state.add(seed, renderer)
    assert state.passed


def test_a_scene_is_determined_by_its_seed():
    one, other = fuzz.scene_of(7), fuzz.scene_of(7)
    assert np.array_equal(one.cloud.means, other.cloud.means)
    assert one.quality == other.quality
    assert not np.array_equal(one.camera.matrix, fuzz.scene_of(8).camera.matrix)


def test_the_scenes_are_hard():
    """The declared distribution, measured on the splats of the scenes."""
    edge_on = near = total = grouped = tilted = 0
    largest, smallest, counts, flat, opacities = 0.0, np.inf, [], 1.0, set()
    for seed in range(150):
        spec = fuzz.scene_of(seed)
        cloud, view = spec.cloud, spec.camera
        rotation = view.world_to_camera[:3, :3]
        p = cloud.means @ rotation.T
        axes = rotation @ quaternion_to_matrix(cloud.quats)
        sine = np.einsum("nk,nk->n", axes[:, :, 2], p) / np.linalg.norm(p, axis=1)
        reach = 3.33 * np.hypot(*(axes[:, 2, :2] * cloud.scales).T)
        edge_on += (np.abs(sine) < 1.5e-6).sum()
        near += (np.abs(p[:, 2] - view.near) < reach).sum()
        total, grouped = total + len(cloud), grouped + cloud.has_coplanar_groups
        tilted += (
            (np.abs(axes[:, 2, 2])[cloud.coplanar_groups >= 0] < 0.9).any()
            if cloud.has_coplanar_groups
            else 0
        )
        largest, smallest = max(largest, cloud.scales.max()), min(smallest, cloud.scales.min())
        flat = max(flat, float((cloud.scales.max(1) / cloud.scales.min(1)).max()))
        counts.append(len(cloud))
        opacities |= set(cloud.opacities.tolist())
        assert p[:, 2].min() > -5000
    assert 0.07 < edge_on / total < 0.13
    assert near / total > 0.1
    assert grouped > 50
    assert tilted > 30
    assert largest > 500
    assert smallest < 1e-10
    assert flat > 5e5
    assert min(counts) <= 5
    assert max(counts) >= 195
    assert opacities == set(fuzz.OPACITIES.tolist())


def test_a_stopped_run_resumes(renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "_SAVE_EVERY", 0.0)
    file = tmp_path / "fuzz.json"
    uninterrupted = list(fuzz.fuzz_run(renderer, 300))[-1]
    run = fuzz.fuzz_run(renderer, 300, file)
    first = next(run)
    run.close()
    saved = json.loads(file.read_text())
    assert (saved["scenes"], saved["splats"]) == (1, first.splats)
    *_, state = fuzz.fuzz_run(renderer, 300, file)
    assert (state.scenes, state.pixels, state.largest) == (
        uninterrupted.scenes,
        uninterrupted.pixels,
        uninterrupted.largest,
    )
    # more splats go on from there; the same number starts again
    *_, more = fuzz.fuzz_run(renderer, 450, file)
    assert more.scenes > state.scenes
    assert next(fuzz.fuzz_run(renderer, 300, file)).scenes == 1


@pytest.mark.parametrize("content", ["", "{", "[]", '{"key": 3}', '{"key": "%s", "scenes": "a", "new": 1}'])
def test_an_invalid_state_file_is_replaced(renderer, tmp_path, content):
    file = tmp_path / "fuzz.json"
    file.write_text(content.replace("%s", fuzz._key(renderer)))
    assert next(fuzz.fuzz_run(renderer, 50, file)).scenes == 1


def test_a_failing_seed_is_reported(renderer, monkeypatch):
    class Wrong(dict):
        """Images with a small error where the error bound is small."""

    def wrong(one, spec):
        frame = render(one, spec)
        return Wrong({name: frame[name] + (1e-3 if name == "alpha" else 0) for name in frame})

    render = fuzz.render
    monkeypatch.setattr(fuzz, "render", wrong)
    state = fuzz.FuzzState("")
    state.add(3, renderer)
    assert state.failing == [3]
    assert not state.passed
    assert state.beyond_bound["alpha"][1] == 3
