"""Derivatives of the reference against central differences of its own images, with constant decisions."""

from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.backends.reference.backend import ReferenceBackend
from fidsplat.backends.reference.gradients import FrozenFrame
from fidsplat.effects.differentiable import with_distortion

OUTPUTS = ("rgb", "alpha", "depth", "normal", "distortion")
CAMERA = fs.Camera.pinhole(14, 11, 12.0, 13.0, 6.6, 5.2, near=0.3)


def splats(n=5, seed=0, *, scale=0.35, opacity=(0.2, 0.9), degree=-1, depth=(1.2, 3.0)):
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    means = np.stack([rng.uniform(-0.5, 0.5, n) * z, rng.uniform(-0.4, 0.4, n) * z, z], 1)
    colors = rng.uniform(0, 1, (n, 3)) if degree < 0 else None
    # many colours below 0, which are clamped
    sh = None if degree < 0 else rng.normal(0, 0.8, (n, (degree + 1) ** 2, 3))
    scales = scale * rng.uniform(0.5, 1.5, (n, 2))
    quats, opacities = rng.normal(size=(n, 4)), rng.uniform(*opacity, n)
    return fs.SplatCloud(means, quats, scales, opacities, colors=colors, sh=sh)


def edge_on():
    """Splats nearly edge-on: most visible ones are circles of the low-pass, whose rays miss the plane or
    meet it far away."""
    cloud = splats(6, 5)
    tilt = np.deg2rad(89.0 + np.arange(6) / 6) / 2
    quats = np.stack([np.cos(tilt), np.sin(tilt), 0 * tilt, 0 * tilt], 1)
    return fs.SplatCloud(cloud.means, quats, 0.2 * cloud.scales, cloud.opacities, colors=cloud.colors)


def before_the_camera():
    """A floor that crosses the near plane and the plane of the camera."""
    quats = [[np.cos(0.7), np.sin(0.7), 0, 0], [np.cos(0.75), np.sin(0.75), 0, 0.1]]
    means = [[0.1, 0.4, 0.6], [-0.2, 0.5, 0.1]]
    return fs.SplatCloud(means, quats, [[0.5, 0.6], [0.7, 0.5]], [0.7, 0.8], colors=np.eye(3)[:2])


def solid(*, thickness=(0.01, 0.5), scale=0.2, seed=8):
    """3D Gaussians and a disk, one Gaussian beyond the image's border."""
    cloud = splats(6, seed, scale=scale)
    means, third = cloud.means.copy(), np.random.default_rng(seed).uniform(*thickness, 6)
    means[1, 0], third[2] = 1.3 * means[1, 2], 0.0
    scales = np.column_stack([cloud.scales, third])
    scales[1] *= 4
    return fs.SplatCloud(means, cloud.quats, scales, cloud.opacities, colors=cloud.colors)


NONE, SCREEN = fs.Quality(lowpass="none", alpha_cutoff=1e-3), fs.Quality(alpha_cutoff=1e-3)
SCENES = {
    "no low-pass": (splats(), NONE),
    "dots": (splats(8, 1, scale=0.03), SCREEN),
    "dots and disks": (splats(6, 2, scale=0.1), SCREEN),
    "edge-on": (edge_on(), SCREEN),
    "ceiling": (splats(5, 3, opacity=(0.8, 1.0)), replace(NONE, opacity_ceiling=0.7)),
    "opaque": (splats(8, 4, opacity=(1.0, 1.0), scale=0.6), NONE),
    "exclusive stop": (
        splats(9, 6, opacity=(0.9, 1.0), scale=0.9),
        replace(fs.Quality.named("surfel"), transmittance_stop=0.05),
    ),
    "near plane": (before_the_camera(), SCREEN),
    "harmonics": (splats(3, 7, degree=3), NONE),
    "EWA": (solid(), SCREEN),
    "EWA, antialiased": (solid(scale=0.04), SCREEN.with_(ellipsoid="ewa_antialiased")),
    "exact": (solid(), NONE.with_(ellipsoid="exact")),
    "exact, dots": (solid(scale=0.02, thickness=(0.005, 0.03)), SCREEN.with_(ellipsoid="exact")),
}


def rendered_scene(name, background=(0.2, 0.5, 0.1)):
    cloud, quality = SCENES[name]
    capture = fs.Capture(CAMERA, outputs=OUTPUTS[:4], quality=quality, background=background)
    features, view = prepare(cloud, capture)
    return cloud, with_distortion(features), view


def weights_of(images, seed=0):
    """A loss that is linear in all images."""
    rng = np.random.default_rng(seed)
    large = {"distortion": 100.0}  # where others are about 1
    return {name: large.get(name, 1.0) * rng.normal(size=images[name].shape) for name in OUTPUTS}


@pytest.mark.parametrize("name", SCENES)
def test_frozen_images_are_the_references(name):
    cloud, features, view = rendered_scene(name)
    backend = ReferenceBackend()
    rendered = backend.pipeline(features).render_view(backend.upload(cloud), view)
    frozen = FrozenFrame(cloud, view, features)
    images = frozen.images(frozen.parameters)
    for output in OUTPUTS:
        assert np.allclose(images[output], rendered.read_float64(output, 0), rtol=1e-9, atol=1e-9), output
    assert images["alpha"].max() > 0.1


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_are_those_of_central_differences(name):
    cloud, features, view = rendered_scene(name)
    frozen = FrozenFrame(cloud, view, features)
    at = frozen.parameters
    weights = weights_of(frozen.images(at))

    def loss(parameters):
        images = frozen.images(parameters)
        return sum((weights[output] * images[output]).sum() for output in OUTPUTS)

    gradients = frozen.backward(weights)
    for parameter in at.names:
        values = getattr(at, parameter)
        expected = np.zeros_like(values)
        for place in np.ndindex(values.shape):
            if parameter == "thickness" and values[place] == 0:
                continue  # a disk stays a disk
            step = 1e-6 * max(1.0, abs(values[place]))
            ends = []
            for sign in (1, -1):
                moved = values.copy()
                moved[place] += sign * step
                ends.append(loss(replace(at, **{parameter: moved})))
            expected[place] = (ends[0] - ends[1]) / (2 * step)
        off = np.abs(gradients[parameter] - expected).max()
        assert off <= 2e-6 * max(1.0, np.abs(expected).max()), (parameter, off)
        assert np.abs(expected).max() > 0, parameter


def test_every_decision_occurs():
    images = {}
    for name in SCENES:
        cloud, features, view = rendered_scene(name)
        ((_, _, images[name]),) = FrozenFrame(cloud, view, features)._blocks
    assert images["dots"].by_lowpass[images["dots"].contributes].all()
    both = images["dots and disks"]
    assert {*both.by_lowpass[both.contributes].tolist()} == {True, False}
    assert images["ceiling"].clamped[images["ceiling"].contributes].any()
    assert (images["edge-on"].missed & images["edge-on"].contributes).any()
    # depths between the centre's and the plane's
    assert {*both.mirrored[both.contributes & ~both.missed].tolist()} == {True, False}
    edge_on = images["edge-on"]
    assert {*edge_on.at_disc[edge_on.mirrored & edge_on.contributes].tolist()} == {True, False}
    assert not images["opaque"].contributes.all()


def test_the_screen_statistic_is_the_derivative_by_the_centres_place():
    """dL_dmean2D of the 2DGS authors: gradient with respect to the position of the centre in the image,
    in half images."""
    cloud, features, view = rendered_scene("dots")
    gradients = FrozenFrame(cloud, view, features).backward({"rgb": np.ones((view.height, view.width, 3))})
    z, (x, y, _) = cloud.means[:, 2].astype(float), gradients["means"].T
    across = 0.5 * z * np.hypot(view.width * x / view.focal_x, view.height * y / view.focal_y)
    assert np.allclose(gradients["grad2d"], across)
    assert across.max() > 0


def test_what_has_no_gradient_is_refused_by_name():
    cloud = splats()
    backend = ReferenceBackend()
    cases = {
        "lowpass_pixel": fs.Capture(CAMERA, quality=fs.Quality(lowpass="pixel")),
        "order_pixel": fs.Capture(CAMERA, quality=fs.Quality(order="pixel")),
        "samples must be 1": fs.Capture(CAMERA, quality=fs.Quality(samples=2)),
        "exposure": fs.Capture(CAMERA, sensor=fs.Sensor(exposure=2.0)),
        "camera_equirectangular": fs.Capture(fs.Camera.equirectangular(32, 16)),
        "background_gradient": fs.Capture(CAMERA, background=fs.Gradient((1, 1, 1), (0, 0, 0))),
    }
    for name, capture in cases.items():
        features, _ = prepare(cloud, capture)
        with pytest.raises(fs.InputError, match=name):
            backend.gradient_pipeline(features)
    features, view = prepare(cloud, fs.Capture(CAMERA, outputs=("rgb", "label")))
    pipeline = backend.gradient_pipeline(features)
    resident = backend.upload(cloud)
    images = pipeline.forward(resident, view)
    with pytest.raises(fs.InputError, match="'label' has no gradient"):
        pipeline.backward(images, {"label": np.zeros((11, 14))})
    with pytest.raises(fs.InputError, match="'depth' was not rendered"):
        pipeline.backward(images, {"depth": np.zeros((11, 14))})
    with pytest.raises(fs.InputError, match=r"must have the shape \(11, 14, 3\), got \(11, 14\)"):
        pipeline.backward(images, {"rgb": np.zeros((11, 14))})
    pipeline.forward(resident, view)
    with pytest.raises(fs.InputError, match="images of an earlier frame"):
        pipeline.backward(images, {})
