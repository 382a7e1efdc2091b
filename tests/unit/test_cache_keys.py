"""Keys of caches and resumed runs: each ingredient by itself makes another key."""

from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.accuracy import quality_within
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest import fuzz
from fidsplat.util import provenance

CAMERA = fs.Camera.pinhole(24, 16, 20.0, 21.0, 12.0, 8.0)
CLOUD = random_splats(5, 1)
FACTS = ("name", "title", "platform", "version")
"""of a device"""


@pytest.fixture
def renderer():
    return fs.Renderer("reference")


class Asked(Exception):
    """Carries the key."""


def key_of_quality(monkeypatch, renderer, **changes):
    """The key under which the answer of a measurement would be cached."""

    def stop(key, *_):
        raise Asked(key)

    monkeypatch.setattr(quality_within, "_cached", stop)
    arguments = {"error": 1e-2, "ms": None, "scene": CLOUD, "capture": fs.Capture(CAMERA), "device": renderer}
    with pytest.raises(Asked) as requested:
        quality_within.choose(**arguments | changes)
    return requested.value.args[0]


def changed_arrays(cloud):
    """Clouds with one number of one array changed."""
    for name in ("means", "quats", "scales", "opacities", "colors"):
        arrays = {
            each: getattr(cloud, each).copy() for each in ("means", "quats", "scales", "opacities", "colors")
        }
        arrays[name].flat[-1] *= 0.5
        yield name, fs.SplatCloud(**arrays)
    yield "labels", cloud.with_labels(1)


def test_measured_qualities_have_a_key_of_every_ingredient(renderer, monkeypatch):
    first = key_of_quality(monkeypatch, renderer)
    assert first == key_of_quality(monkeypatch, renderer)
    capture = fs.Capture(CAMERA)
    keys = {"": first}
    for name, requested in {
        "error": {"error": 1.1e-2},
        "ms": {"ms": 5.0},
        "error alone": {"error": None, "ms": 5.0},
        "fx": {"capture": replace(CAMERA, fx=20.5)},
        "fy": {"capture": replace(CAMERA, fy=20.5)},
        "size": {"capture": replace(CAMERA, width=25)},
        "pose": {"capture": CAMERA.with_pose(np.eye(4) + np.eye(4, k=3))},
        "near": {"capture": replace(CAMERA, near=0.5)},
        "lens": {"capture": replace(CAMERA, lens=fs.BrownConrady(k1=0.1))},
        "background": {"capture": capture.with_(background=(0.0, 0.0, 0.1))},
        "fog": {"capture": capture.with_(fog=fs.Fog(0.1))},
        "quality": {"capture": capture.with_(quality="lowpass=none")},
        **{name: {"scene": cloud} for name, cloud in changed_arrays(CLOUD)},
    }.items():
        keys[name] = key_of_quality(monkeypatch, renderer, **requested)
    for name in FACTS:
        with monkeypatch.context() as patch:
            patch.setattr(renderer.backend, "info", replace(renderer.device, **{name: "another"}))
            keys[name] = key_of_quality(patch, renderer)
    with monkeypatch.context() as patch:
        patch.setattr(quality_within, "code_hash", lambda: "another")
        keys["code"] = key_of_quality(patch, renderer)
    assert len(set(keys.values())) == len(keys), keys
    assert None not in keys.values()
    # outputs and the sensor do not change what is measured
    rest = capture.with_(outputs=("rgb", "depth"), sensor=fs.Sensor(gain=2.0))
    assert key_of_quality(monkeypatch, renderer, capture=rest) == first


def test_runs_of_random_scenes_resume_only_with_the_same_device_and_code(renderer, monkeypatch):
    keys = {"": fuzz._key(renderer)}
    for name in FACTS[1:]:
        with monkeypatch.context() as patch:
            patch.setattr(renderer.backend, "info", replace(renderer.device, **{name: "another"}))
            keys[name] = fuzz._key(renderer)
    with monkeypatch.context() as patch:
        patch.setattr(fuzz, "code_hash", lambda: "another")
        keys["code"] = fuzz._key(renderer)
    assert len(set(keys.values())) == len(keys), keys


SOURCES = provenance.sources()
GROUPS = sorted({(name.rpartition("/")[0], file.suffix) for name, file in SOURCES.items()})


def code(monkeypatch, tree):
    with monkeypatch.context() as patch:
        patch.setattr(provenance, "sources", lambda: tree)
        return provenance.code_hash.__wrapped__()


def test_code_is_the_content_and_the_name_of_every_source(tmp_path, monkeypatch):
    """One file of each folder and kind at a time: another byte, another name, no such file."""
    before, seen = code(monkeypatch, SOURCES), set()
    for k, (folder, suffix) in enumerate(GROUPS):
        name = min(n for n, f in SOURCES.items() if (n.rpartition("/")[0], f.suffix) == (folder, suffix))
        rest = {other: file for other, file in SOURCES.items() if other != name}
        (tmp_path / str(k)).write_bytes(SOURCES[name].read_bytes() + b" ")
        for tree in (rest, rest | {name: tmp_path / str(k)}, rest | {f"{name}x": SOURCES[name]}):
            seen.add(code(monkeypatch, tree))
    assert before not in seen
    assert len(seen) == 3 * len(GROUPS)


def test_bytes_that_move_from_one_source_to_the_next_are_other_code(tmp_path, monkeypatch):
    for name, content in (("a", b"12"), ("b", b"34"), ("c", b"123"), ("d", b"4")):
        (tmp_path / name).write_bytes(content)
    files = {name: tmp_path / name for name in "abcd"}
    one = code(monkeypatch, {"x": files["a"], "y": files["b"]})
    assert one != code(monkeypatch, {"x": files["c"], "y": files["d"]})
    assert one != code(monkeypatch, {"x": files["b"], "y": files["a"]})
    assert one == code(monkeypatch, {"y": files["b"], "x": files["a"]})
