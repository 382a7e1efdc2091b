"""fidsplat warm: compiled kernels, and its report."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sampling import sampled

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.effects import select
from fidsplat.experiments.bench import warm as warming
from fidsplat.worlds.yard import demo_scene


def test_recipes_are_what_scenes_call_for():
    expected = warming.recipes()
    assert len(set(expected)) == len(expected)
    assert len({recipe.text for recipe in expected}) == len(expected)
    called_for = {
        select(warming._cloud(recipe, 5), fs.Capture(outputs=recipe.outputs, quality=recipe.quality))
        for recipe in expected
    }
    assert len(called_for) == len(expected)
    tag, demo = fs.marker("apriltag:36h11:5").cloud, demo_scene()
    assert select(tag, fs.Capture()) in called_for
    assert select(demo.cloud(), demo.capture) in called_for
    capture = fs.SplatCloud([[0, 0, 1]], [[1, 0, 0, 0]], [[1, 1, 1]], [1], sh=np.zeros((1, 16, 3)))
    assert select(capture, fs.Capture()) in called_for
    assert select(fs.SplatCloud.concatenate([capture, tag]), fs.Capture(outputs=("depth",))) in called_for


@pytest.mark.parametrize("recipe", sampled(warming.recipes(), 3, 2), ids=lambda recipe: recipe.text)
def test_a_recipe_compiles_what_its_words_say(renderer, recipe):
    ((done, seconds),) = warming.warm(renderer, [recipe])
    assert done is recipe
    assert seconds > 0
    cloud = warming._cloud(recipe, 5)
    assert cloud.sh_degree == recipe.sh_degree

    features = select(cloud, fs.Capture(outputs=recipe.outputs, quality=recipe.quality))
    # a device without float64 has these in float32
    expected = replace(features, projection_precision="")
    compiled = [replace(key[0], projection_precision="") for key in renderer.backend._pipelines]
    assert expected in compiled


def test_the_command(capsys, monkeypatch):
    few = warming.recipes()[:2]
    monkeypatch.setattr(warming, "recipes", lambda: few)
    assert main(["warm", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [entry["set"] for entry in content["sets"]] == [recipe.text for recipe in few]
    assert content["of"] == 2
    assert content["seconds"] >= sum(entry["seconds"] for entry in content["sets"])
    assert main(["warm"]) == 0
    assert "2 of 2 sets of kernels are ready" in capsys.readouterr().out


def test_an_interrupt_says_what_is_ready(capsys, monkeypatch):
    def stopped(renderer, expected):
        yield expected[0], 0.1
        raise KeyboardInterrupt

    monkeypatch.setattr(warming, "warm", stopped)
    assert main(["warm"]) == 130
    assert "1 of 22 sets of kernels are ready" in capsys.readouterr().out


def test_a_device_that_is_not_there(capsys):
    assert main(["warm", "--device", "opencl:nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err
