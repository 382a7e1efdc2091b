"""fidsplat warm: what it compiles, and what it says."""

import json
from dataclasses import replace

import pytest
from sampling import in_turn, sampled
from traits import Traits

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.effects import select
from fidsplat.experiments.bench import warm as warming


def test_recipes_are_what_scenes_call_for():
    wanted = warming.recipes()
    assert len(set(wanted)) == len(wanted)
    assert len({recipe.words for recipe in wanted}) == len(wanted)
    tag = fs.marker("apriltag:36h11:5").gaussians
    assert (tag.sh_degree, tag.planes is not None) == (-1, True)
    assert warming.Recipe(-1, True, ("rgb",)) in wanted
    assert warming.Recipe(-1, True, ("rgb", "depth", "normal", "label")) in wanted  # the demo's
    assert warming.Recipe(3, False, ("rgb",)) in wanted  # a captured scene's


@in_turn()
@pytest.mark.parametrize("recipe", sampled(warming.recipes(), 3, 2), ids=lambda recipe: recipe.words)
def test_a_recipe_compiles_what_its_words_say(renderer, recipe):
    ((done, seconds),) = warming.warm(renderer, [recipe])
    assert done is recipe
    assert seconds > 0
    cloud = warming._cloud(recipe, 5)
    assert cloud.sh_degree == recipe.sh_degree

    features = select(
        Traits(recipe.sh_degree, recipe.markers),
        fs.Capture(outputs=recipe.outputs, quality=recipe.quality),
    )
    # a device without float64 has these in float32
    wanted = replace(features, setup_precision="")
    compiled = [replace(key[0], setup_precision="") for key in renderer.backend._pipelines]
    assert wanted in compiled


def test_the_command(capsys, monkeypatch):
    few = warming.recipes()[:2]
    monkeypatch.setattr(warming, "recipes", lambda: few)
    assert main(["warm", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [entry["set"] for entry in content["sets"]] == [recipe.words for recipe in few]
    assert content["of"] == 2
    assert content["seconds"] >= sum(entry["seconds"] for entry in content["sets"])
    assert main(["warm"]) == 0
    assert "2 of 2 sets of kernels are ready" in capsys.readouterr().out


def test_an_interrupt_says_what_is_ready(capsys, monkeypatch):
    def stopped(renderer, wanted):
        yield wanted[0], 0.1
        raise KeyboardInterrupt

    monkeypatch.setattr(warming, "warm", stopped)
    assert main(["warm"]) == 130
    assert "1 of 18 sets of kernels are ready" in capsys.readouterr().out


def test_a_device_that_is_not_there(capsys):
    assert main(["warm", "--device", "opencl:nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err
