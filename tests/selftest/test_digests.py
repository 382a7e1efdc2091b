"""Random scenes have one digest on all devices."""

import json
from dataclasses import replace

import pytest

from fidsplat.backends.opencl import pipeline
from fidsplat.cli import main
from fidsplat.selftest import digests


def test_the_table_has_all_scenes():
    assert list(digests.read_table()) == list(range(digests.COUNT))


@pytest.mark.parametrize("kind", digests.KINDS, ids=lambda kind: kind.name)
def test_devices_render_the_digests_of_the_table(renderer, monkeypatch, kind):
    """Each kind of scene is on one device in a run, which compiles a feature set for it."""
    monkeypatch.setattr(pipeline, "MIN_VECTORISED", 0)  # projection is vectorised where it can be
    expected = {seed: row for seed, row in digests.read_table().items() if digests.kind_of(seed) == kind}
    assert len(expected) == digests.COUNT // len(digests.KINDS)
    differing = {
        seed: actual.differing(row)
        for seed, row in expected.items()
        if (actual := digests.digest_of(renderer, seed)) != row
    }
    assert not differing


def test_digests_do_not_depend_on_vectorised_set_up(renderer):
    """The scenes have few splats, whose projection is not vectorised."""
    for seed, expected in digests.read_table().items():
        if seed % 50 == 0:
            assert digests.digest_of(renderer, seed) == expected, digests.kind_of(seed).name


def test_the_command_names_scenes_that_differ(renderer, monkeypatch, capsys):
    expected = {seed: digests.read_table()[seed] for seed in (0, 20)}
    command = ["check", "--digests", "--device", renderer.device.name]
    monkeypatch.setattr(digests, "read_table", lambda: expected)
    assert main(command) == 0
    assert "2 of 2 scenes are bit-identical" in capsys.readouterr().out
    outputs = expected[20].outputs | {"depth": "00000000"}
    expected[20] = replace(expected[20], sha256="0" * 64, outputs=outputs)
    assert main(command) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "1 of 2" in line and "disks" in line]
    assert line.split() == ["disks", "1", "of", "2", "depth", "20"]
    assert main([*command, "--json"]) == 1
    loaded = json.loads(capsys.readouterr().out)
    assert (loaded["passed"], list(loaded["sha256"])) == (False, ["0", "20"])
    (only,) = loaded["differing"]
    assert (only["seed"], only["differing"]) == (20, ["depth"])
    assert {"nu0", "keys", "samples"} <= set(only["stages"])
