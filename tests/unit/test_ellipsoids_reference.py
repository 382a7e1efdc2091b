"""3D Gaussians in the float64 reference: against rays through them, against the formulas of 3DGS, and
against disks."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.rotations import quaternion_to_matrix

WIDTH, HEIGHT, FOCAL, NEAR = 60, 44, 40.0, 0.05
CUT = 1e-4
EXACT = fs.Quality(ellipsoid="exact", lowpass="none", alpha_cutoff=CUT)
PINHOLE = fs.Camera.pinhole(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, near=NEAR)


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("reference")


def one(generator, low, high, spread=0.8):
    """A cloud of one 3D Gaussian with its centre in [low, high]."""
    scales = np.exp(generator.normal(-1.5, spread, (1, 3)))
    return fs.SplatCloud(
        generator.uniform(low, high, (1, 3)), generator.normal(size=(1, 4)), scales, [0.8], colors=[[1, 1, 1]]
    )


def rays(camera):
    """Origins and directions (h, w, 3) of the pixels' rays."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    if isinstance(camera.lens, fs.Orthographic):
        return np.stack([x, y, 0 * x], 2), np.broadcast_to([0.0, 0.0, 1.0], (*x.shape, 3))
    return np.zeros((*x.shape, 3)), np.stack([x, y, np.ones_like(x)], 2)


def largest_value(cloud, camera):
    """Alpha and depth (h, w) where the Gaussian is largest along each ray."""
    scales = np.append(cloud.scales[0], cloud.thickness[0]).astype(float)
    whiten = (quaternion_to_matrix(cloud.quats.astype(float))[0] / scales).T
    origins, directions = rays(camera)
    to_center = (cloud.means[0] - origins) @ whiten.T
    along = directions @ whiten.T
    t = (to_center * along).sum(2) / (along**2).sum(2)
    rho = ((to_center - t[..., None] * along) ** 2).sum(2)
    alpha = cloud.opacities[0] * np.exp(-rho / 2)
    ahead = True if isinstance(camera.lens, fs.Orthographic) else t >= NEAR
    alpha = np.where((alpha >= CUT) & ahead, alpha, 0)
    return alpha, np.where(alpha >= 1 / 255, t, 0)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("place", ["ahead", "around the camera"])
def test_exact_is_the_largest_value_along_each_ray(renderer, seed, place):
    generator = np.random.default_rng(seed)
    low, high = ((-1, -1, 1), (1, 1, 4)) if place == "ahead" else (-1, 1)
    cloud = one(generator, low, high)
    frame = renderer.render(cloud, PINHOLE, ("alpha", "depth"), EXACT)
    alpha, depth = largest_value(cloud, PINHOLE)
    np.testing.assert_allclose(frame["alpha"], alpha, atol=2e-7)
    np.testing.assert_allclose(frame["depth"], depth, rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_exact_under_parallel_rays(renderer, seed):
    camera = fs.Camera.orthographic(WIDTH, HEIGHT, 4.0)
    cloud = one(np.random.default_rng(seed), (-1, -1, 4), (1, 1, 6))
    frame = renderer.render(cloud, camera, ("alpha", "depth"), EXACT)
    alpha, depth = largest_value(cloud, camera)
    np.testing.assert_allclose(frame["alpha"], alpha, atol=2e-7)
    np.testing.assert_allclose(frame["depth"], depth, rtol=1e-6)


@pytest.mark.parametrize("way", ["exact", "ewa", "ewa_antialiased"])
def test_the_normal_is_that_of_the_surface_of_largest_values_at_the_centre(renderer, way):
    """Sigma^-1 p, turned towards the camera: -p of a ball, the disk's own of a flat one."""
    for thickness, reference in ((0.3, (0.6, 0, 0.8)), (1e-4, None)):
        cloud = fs.SplatCloud(
            [[1.2, 0, 1.6]], [[1, 0.3, -0.2, 0.4]], [[0.3, 0.3, thickness]], [1.0], colors=[[1, 1, 1]]
        )
        normal = renderer.render(cloud, PINHOLE, ("normal",), fs.Quality(ellipsoid=way))["normal"]
        middle = normal[HEIGHT // 2, WIDTH // 2 + 30 - 1]
        own = quaternion_to_matrix(cloud.quats)[0, :, 2]
        expected = -np.array(reference) if reference else -own * np.sign(own @ cloud.means[0])
        np.testing.assert_allclose(middle, expected, atol=1e-5)


def published(cloud, camera, antialiased, depth_near=NEAR):
    """RGB (h, w, 3) and alpha of 3DGS in float64 by gsplat's formulas: projected covariance, 0.3, conic."""
    w, h, fx, fy, cx, cy = WIDTH, HEIGHT, camera.fx, camera.fy, camera.cx, camera.cy
    y, x = np.mgrid[0:h, 0:w] + 0.5
    color, light = np.zeros((h, w, 3)), np.ones((h, w))
    turns = quaternion_to_matrix(cloud.quats.astype(float))
    scales = np.column_stack([cloud.scales, cloud.thickness]).astype(float)
    for k in np.argsort(cloud.means[:, 2], kind="stable"):
        p = cloud.means[k].astype(float)
        if p[2] < depth_near:
            continue
        sigma = turns[k] @ np.diag(scales[k] ** 2) @ turns[k].T
        tan_x, tan_y = 0.5 * w / fx, 0.5 * h / fy
        tx = p[2] * min((w - cx) / fx + 0.3 * tan_x, max(-(cx / fx + 0.3 * tan_x), p[0] / p[2]))
        ty = p[2] * min((h - cy) / fy + 0.3 * tan_y, max(-(cy / fy + 0.3 * tan_y), p[1] / p[2]))
        jacobian = np.array([[fx / p[2], 0, -fx * tx / p[2] ** 2], [0, fy / p[2], -fy * ty / p[2] ** 2]])
        image = jacobian @ sigma @ jacobian.T
        blurred = image + 0.3 * np.eye(2)
        opacity = float(cloud.opacities[k])
        if antialiased:
            opacity *= math.sqrt(max(0.0, np.linalg.det(image) / np.linalg.det(blurred)))
        conic = np.linalg.inv(blurred)
        dx, dy = x - (fx * p[0] / p[2] + cx), y - (fy * p[1] / p[2] + cy)
        power = 0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) + conic[0, 1] * dx * dy
        alpha = opacity * np.exp(-power)
        alpha = np.where(alpha >= CUT, alpha, 0)
        color += (light * alpha)[..., None] * cloud.colors[k]
        light = light * (1 - alpha)
    return color, 1 - light


@pytest.mark.parametrize("way", ["ewa", "ewa_antialiased"])
def test_ewa_is_that_of_3dgs(renderer, way):
    """Also of centres far outside the image, needles, and splats far below a pixel."""
    generator = np.random.default_rng(4)
    means = np.column_stack([generator.uniform(-4, 4, (60, 2)), generator.uniform(0.1, 4, 60)])
    scales = np.exp(generator.uniform(-8, 0, (60, 3)))
    cloud = fs.SplatCloud(
        means,
        generator.normal(size=(60, 4)),
        scales,
        generator.uniform(0, 1, 60),
        colors=generator.random((60, 3)),
    )
    quality = fs.Quality(ellipsoid=way, alpha_cutoff=CUT, transmittance_stop=0)
    frame = renderer.render(cloud, PINHOLE, ("rgb", "alpha"), quality)
    color, alpha = published(cloud, PINHOLE, way == "ewa_antialiased")
    np.testing.assert_allclose(frame["rgb"], color, atol=3e-6)
    np.testing.assert_allclose(frame["alpha"], alpha, atol=3e-6)


@pytest.mark.parametrize(("away", "degrees", "error"), [(3, 20, 0.23), (10, 40, 0.11), (30, 20, 0.014)])
def test_ewa_has_its_published_error(renderer, away, degrees, error):
    """One ball, `away` standard deviations off, 10 px to a standard deviation (devlog/primitives.md)."""
    angle, focal = math.radians(degrees), 10.0 * away
    center = away * np.array([[math.sin(angle), 0, math.cos(angle)]])
    ball = fs.SplatCloud(center, [[1, 0, 0, 0]], [[1, 1, 1]], [1.0], colors=[[1, 1, 1]])
    width, height = (2 * int(40 / math.cos(angle) ** power) + 3 for power in (2, 1))
    # the principal point puts the ball in the middle of the image
    camera = fs.Camera.pinhole(
        width, height, focal, focal, width / 2 - focal * math.tan(angle), height / 2, near=1e-3
    )
    exact, ewa = (
        renderer.render(ball, camera, "alpha", fs.Quality(ellipsoid=way))["alpha"] for way in ("exact", "ewa")
    )
    assert np.abs(exact - ewa).max() == pytest.approx(error, rel=0.06)


def test_two_samples_widen_by_the_same_part_of_a_pixel(renderer):
    """A splat far below a pixel has the same width in pixels whatever the samples."""
    cloud = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[1e-3] * 3], [1.0], colors=[[1, 1, 1]])
    one, two = (
        renderer.render(cloud, PINHOLE, ("alpha",), fs.Quality(samples=n))["alpha"].sum() for n in (3, 6)
    )
    assert one == pytest.approx(2 * math.pi * 0.3, rel=0.01)
    assert two == pytest.approx(one, rel=0.01)


def test_a_flat_ellipsoid_is_a_disk(renderer):
    """80 dB at a third scale of 1e-6 of the others."""
    generator = np.random.default_rng(3)
    means = np.column_stack([generator.uniform(-1, 1, (40, 2)), generator.uniform(0.5, 4, 40)])
    scales = generator.uniform(0.05, 0.4, (40, 3))
    scales[:, 2] = 1e-6 * scales[:, :2].min(axis=1)
    quats, opacities, colors = generator.normal(size=(40, 4)), generator.random(40), generator.random((40, 3))
    thick = fs.SplatCloud(means, quats, scales, opacities, colors=colors)
    disks = fs.SplatCloud(means, quats, scales[:, :2], opacities, colors=colors)
    quality = fs.Quality(ellipsoid="exact")
    error = (
        renderer.render(thick, PINHOLE, quality=quality)["rgb"]
        - renderer.render(disks, PINHOLE, quality=quality)["rgb"]
    )
    assert -10 * math.log10(max(float((error**2).mean()), 1e-20)) > 80


def test_lenses_have_exact_ellipsoids():
    fisheye = fs.Camera.fisheye(WIDTH, HEIGHT, math.radians(170))
    from fidsplat.effects import select

    cloud = one(np.random.default_rng(0), (0, 0, 1), (0, 0, 2))
    for camera, name in ((PINHOLE, "ellipsoid_ewa"), (fisheye, "ellipsoid_exact")):
        features = select(cloud, fs.Capture(camera, quality=fs.Quality()))
        assert name in features.effects
        assert ("lowpass_none" in features.effects) == (camera is PINHOLE)
    assert not [
        name for name in select(cloud.flattened(), fs.Capture(PINHOLE)).effects if "ellipsoid" in name
    ]
