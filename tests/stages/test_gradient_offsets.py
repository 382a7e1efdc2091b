"""Gradient buffer offsets: a splat has one entry for each tile that lists it. A surplus entry would be read
without being written."""

import numpy as np
import pyopencl as cl
import pytest

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.scenes.random_clouds import random_splats

BACKEND = "opencl"
# found by fuzzing: rounding makes the chord of a row of tiles wider than the bounds
WIDE = fs.SplatCloud(
    means=[[1.4574198, 0.11504277, 2.0842366]],
    quats=[[0.70251703, -0.14637895, 0.6260615, -0.3051065]],
    scales=[[0.54311776, 0.02383298]],
    opacities=[0.99],
    colors=[[0.5, 0.5, 0.5]],
)


@pytest.mark.sweep
def test_splats_have_an_offset_for_each_tile_that_lists_them(renderer):
    backend = renderer.backend
    random = random_splats(300, 0, scale=(0.02, 0.6), depth=(1.5, 4.0), sh_degree=None)
    for shape in (None, *backend.configs("schedule").values()):
        for cloud, side in ((WIDE, 800), (random, 300)):
            camera = fs.Camera.look_at(side, side, 1.0, (0, 0, 0), (0, 0, 3.0))
            features, view = prepare(cloud, fs.Capture(camera))
            pipeline = backend.gradient_pipeline(features, config=shape)
            images = pipeline.forward(backend.upload(cloud), view)
            pipeline.backward(images, {"rgb": np.ones((side, side, 3), np.float32)})
            frame, words = images.frame, np.empty(1, np.uint32)
            cl.enqueue_copy(frame.queue, words, frame.pool.get("reserved"))
            assert words[0] == frame.count_pairs() > 32, (shape, len(cloud))
