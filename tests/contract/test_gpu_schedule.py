"""The schedule for GPUs of each backend, on whatever device this is, with lenses and the effects of samples
and pixels: against the reference, as a CPU's schedule is by the other tests. Where these run there is no GPU.
"""

import ctypes
import mmap
import multiprocessing

import numpy as np
import pytest
from agreement import random_splats, reference_images
from optimisation import compile_quickly
from test_lens_frames import CAMERAS

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.effects import OUTPUTS
from fidsplat.selftest.agreement import FrameSpec, compare

CAMERA = fs.Camera.look_at(81, 59, 1.0, (0.3, -0.2, -0.1), (0.0, 0.1, 3.0))
EVERYTHING = tuple(OUTPUTS)
AROUND = random_splats(90, seed=3, depth=(-0.5, 5.0))
MIXED = AROUND.with_boxes(np.arange(90) % 3 == 0)
THICK = fs.SplatCloud(
    AROUND.means, AROUND.quats, np.column_stack([AROUND.scales, AROUND.scales[::-1, 0]]), AROUND.opacities,
    colors=AROUND.colors,
)  # fmt: skip


def scene_of_layers():
    """A marker of boxes, one of Gaussians, splats and boxes of no plane, and ten layers that cross, so that
    many wait."""
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    pose[:3, 3] = (0.1, 0, 2.2)
    exact = fs.marker("aruco:4x4_50:7", size=0.8, mixture="exact").cloud.transformed(pose)
    pose[:3, 3] = (-0.4, 0.1, 2.5)
    fitted = fs.marker("aruco:4x4_50:7", size=0.8, mixture="fitted").cloud.transformed(pose)
    crossing = random_splats(40, seed=6, depth=(1.0, 3.0), scale=(0.2, 0.8), across=0.5)
    return fs.SplatCloud.concatenate(
        [exact, fitted, MIXED, crossing.with_coplanar_groups(np.arange(40) // 4)]
    )


PICTURES = {
    "layers": lambda: FrameSpec(scene_of_layers(), CAMERA, outputs=EVERYTHING, fog=fs.Fog(0.3)),
    "boxes": lambda: FrameSpec(AROUND.with_boxes(), CAMERA, outputs=("rgb", "depth_first", "blended")),
    "pixel": lambda: FrameSpec(
        AROUND, CAMERA, fs.Quality(lowpass="pixel", samples=2), background=fs.Gradient((0, 0, 1), (1, 0, 0))
    ),
    "3D Gaussians, exact": lambda: FrameSpec(
        fs.SplatCloud.concatenate([THICK, MIXED]), CAMERA, fs.Quality(ellipsoid="exact"), ("rgb", "depth")
    ),
    "3D Gaussians": lambda: FrameSpec(THICK, CAMERA, outputs=("rgb", "depth")),
    "gsplat": lambda: FrameSpec(AROUND, CAMERA, fs.Quality.of("gsplat"), outputs=EVERYTHING),
    **{
        name: lambda camera=CAMERAS[name]: FrameSpec(MIXED, camera, outputs=EVERYTHING, fog=fs.Fog(0.3))
        for name in ("fisheye 200", "distortion", "panorama", "parallel")
    },
}


@pytest.mark.parametrize("name", PICTURES)
def test_the_schedule_of_gpus_agrees_with_the_reference(renderer, name):
    image = PICTURES[name]()
    backend, cloud = renderer.backend, image.cloud
    features, view = prepare(cloud, image.capture)
    images = backend.pipeline(features, backend.configs("schedule")["groups"]).render_view(
        backend.upload(cloud), view
    )
    rendered = {output: images.read(output, 0) for output in image.outputs}
    differences = compare(rendered, reference_images(image), image.outputs)
    assert all(difference.agrees for difference in differences), differences
    assert rendered["rgb"].std() > 0.05


def test_warp_reads_no_ray_outside_the_image():
    """A tile has samples there too. The rays end at a page that no one may read, in a process of its own."""
    pytest.importorskip("warp")
    process = multiprocessing.get_context("spawn").Process(target=draw_with_guarded_rays)
    process.start()
    process.join()
    assert process.exitcode == 0


def draw_with_guarded_rays():
    """The image "distortion" on Warp's CPU."""
    import warp as wp

    compile_quickly()
    backend = fs.Renderer("warp:cpu").backend
    retained = []

    def before_a_guard(name, size, dtype):
        length = size * wp.types.type_size_in_bytes(dtype)
        room = -(-length // mmap.PAGESIZE) * mmap.PAGESIZE
        memory = mmap.mmap(-1, room + mmap.PAGESIZE)
        retained.append(memory)
        guard = ctypes.addressof(ctypes.c_char.from_buffer(memory)) + room
        nobody = 0
        assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(guard), mmap.PAGESIZE, nobody) == 0
        return wp.array(ptr=guard - length, dtype=dtype, shape=(size,), device="cpu")

    backend.pool.allocate = before_a_guard
    image = PICTURES["distortion"]()
    features, view = prepare(image.cloud, image.capture)
    pipeline = backend.pipeline(features, backend.configs("schedule")["groups"])
    pipeline.render_view(backend.upload(image.cloud), view).read("rgb", 0)
