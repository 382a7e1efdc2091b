"""OpenUSD: ParticleField with the Gaussian surflet kernel, which is a 2D splat as ours, or of 3D Gaussians as
ParticleField3DGaussianSplat (extra `usd`). Schemas: openusd.org, usdVol.

USD stages here have y up: the splats are written as they are, under a half turn about x. Labels and planes
stand in attributes of our own, fidsplat:labels and fidsplat:planes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.errors import InputError
from fidsplat.files import atomic_path, open_input, utf8_path
from fidsplat.formats.plain import (
    HALF_TURN,
    cloud_of,
    coefficients,
    refuse_boxes,
    three_scales,
    world_means,
)
from fidsplat.input_limit import check_expansion
from fidsplat.splats import SplatCloud

_SURFLET = "ParticleFieldKernelGaussianSurfletAPI"
_ENTRY = 32
"""bytes of memory that an entry of a section takes"""
_KINDS = ("ParticleField", "ParticleField3DGaussianSplat")


def load_usd(path: Path) -> SplatCloud:
    """Read the splats of a .usda, .usdc or .usd file, all its fields of Gaussians, as one cloud.

    Raises:
        InputError: it is damaged, holds no such field, or one whose kernel is not known; the extra is
            missing.
    """
    pxr = _pxr()
    try:
        _check_sections(path)
        with utf8_path(path) as name:
            return _load(pxr, path, name)
    except InputError:
        raise
    # also of arrays, which are read late, when they are requested
    except (pxr.Tf.ErrorException, RuntimeError, OSError, OverflowError, ValueError):
        raise InputError(f"{path} is not a USD file that can be read") from None


def _check_sections(path: Path) -> None:
    """Check the counts of a crate file's sections, by which USD takes memory before it reads what they count
    (pxr/usd/sdf/crateFile.cpp). Raises InputError beyond the limit."""
    with open_input(path) as stream:
        head = stream.read(24)
        if head[:8] != b"PXR-USDC" or len(head) < 24:
            return
        stream.seek(int.from_bytes(head[16:24], "little"))
        count = int.from_bytes(stream.read(8), "little")
        sections = [stream.read(32) for _ in range(min(count, 64))]
        for section in sections:
            stream.seek(int.from_bytes(section[16:24], "little"))
            name, numbers = section[:16].rstrip(b"\0").decode("ascii", "replace"), stream.read(16)
            counts = [int.from_bytes(numbers[at : at + 8], "little") for at in (0, 8)]
            need = max(_ENTRY * counts[0], counts[1] if name == "TOKENS" else 0)  # tokens also have a length
            check_expansion(path, need, f"{counts[0]:,} entries in its section {name}")


def _load(pxr: Any, path: Path, name: Path) -> SplatCloud:
    stage = pxr.Usd.Stage.Open(str(name), pxr.Usd.Stage.LoadAll)
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() in _KINDS]
    if not prims:
        raise InputError(f"{path} holds no ParticleField")
    up = HALF_TURN if pxr.UsdGeom.GetStageUpAxis(stage) == "Y" else np.eye(4)
    metres = pxr.UsdGeom.GetStageMetersPerUnit(stage) if stage.HasAuthoredMetadata("metersPerUnit") else 1.0
    clouds = []
    for prim in prims:
        # USD's matrices act on rows
        placed = np.array(pxr.UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T
        matrix = np.diag([metres, metres, metres, 1.0]) @ up @ placed
        cloud = _cloud(path, prim)
        clouds.append(cloud if np.abs(matrix - np.eye(4)).max() < 1e-12 else cloud.transformed(matrix))
    return clouds[0] if len(clouds) == 1 else SplatCloud.concatenate(clouds)


def save_usd(cloud: SplatCloud, path: Path) -> None:
    """Write a .usda, .usdc or .usd file. Raises InputError for boxes, or where it cannot be written."""
    refuse_boxes(cloud, "USD")
    pxr = _pxr()
    flat, suffix = cloud.thickness is None, path.suffix.lower()
    stage = pxr.Usd.Stage.CreateInMemory(f"splats{suffix}")
    pxr.UsdGeom.SetStageUpAxis(stage, "Y")
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim("/Splats", _KINDS[0] if flat else _KINDS[1])
    stage.SetDefaultPrim(prim)
    if flat:
        for name in ("PositionAttribute", "OrientationAttribute", "ScaleAttribute", "OpacityAttribute"):
            prim.ApplyAPI(f"ParticleField{name}API")
        prim.ApplyAPI("ParticleFieldSphericalHarmonicsAttributeAPI")
        prim.ApplyAPI(_SURFLET)
    means, sh = world_means(cloud), coefficients(cloud)
    scales = three_scales(cloud)
    if flat:
        scales[:, 2] = 1.0  # the kernel lies in the plane z = 0
    vt = pxr.Vt
    values = {
        "positions": vt.Vec3fArray.FromNumpy(np.ascontiguousarray(means)),
        "scales": vt.Vec3fArray.FromNumpy(scales),
        "orientations": vt.QuatfArray.FromNumpy(np.ascontiguousarray(cloud.quats[:, [1, 2, 3, 0]])),
        "opacities": vt.FloatArray.FromNumpy(cloud.opacities),
        "radiance:sphericalHarmonicsDegree": int(np.sqrt(sh.shape[1])) - 1,
        "radiance:sphericalHarmonicsCoefficients": vt.Vec3fArray.FromNumpy(
            np.ascontiguousarray(sh.reshape(-1, 3))
        ),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    whole = {"labels": cloud.labels if cloud.labels.any() else None, "planes": cloud.planes}
    for name, numbers in whole.items():
        if numbers is not None:
            made = prim.CreateAttribute(f"fidsplat:{name}", pxr.Sdf.ValueTypeNames.IntArray, True)
            made.Set(vt.IntArray.FromNumpy(numbers))
    if len(cloud):
        extent = np.array(cloud.bounds(), np.float32)
        prim.GetAttribute("extent").Set(vt.Vec3fArray.FromNumpy(extent))
    pxr.UsdGeom.Xformable(prim).AddRotateXOp().Set(180.0)
    with atomic_path(path, suffix) as part:
        try:
            done = stage.GetRootLayer().Export(str(part))
        except pxr.Tf.ErrorException:
            done = False
        if not done:
            raise InputError(f"cannot write {path}: USD says no more; is the disk full?")


def _cloud(path: Path, prim: Any) -> SplatCloud:
    surflet = _SURFLET in prim.GetAppliedSchemas()
    if prim.GetTypeName() == _KINDS[0] and not surflet:
        raise InputError(f"{path}: the kernel of {prim.GetPath()} is not known; Gaussian surflets are")

    def array(name: str) -> np.ndarray:
        found = prim.GetAttribute(name).Get() or prim.GetAttribute(f"{name}h").Get()  # h: in half precision
        if found is None:
            raise InputError(f"{path}: {prim.GetPath()} has no {name}")
        return np.array(found)

    means = array("positions").astype(np.float32)
    imaginary_first = array("orientations").astype(np.float32)
    scales = array("scales").astype(np.float32)
    if surflet:
        scales[:, 2] = 0
    degree = int(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() or 0)
    sh = array("radiance:sphericalHarmonicsCoefficients").astype(np.float32)
    n, k = len(means), (degree + 1) ** 2
    if len(sh) != n * k:
        raise InputError(f"{path}: {prim.GetPath()} has {len(sh)} SH coefficients for {n} splats of {k}")
    labels, planes = (prim.GetAttribute(f"fidsplat:{name}").Get() for name in ("labels", "planes"))
    quats = imaginary_first[:, [3, 0, 1, 2]]
    labels, planes = (None if each is None else np.array(each) for each in (labels, planes))
    sh = sh.reshape(n, k, 3)
    return cloud_of(path, means, quats, scales, array("opacities"), sh, labels=labels, planes=planes)


def _pxr() -> Any:
    try:
        import pxr.Gf  # type: ignore[import-not-found]
        import pxr.Sdf  # type: ignore[import-not-found]
        import pxr.Tf  # type: ignore[import-not-found]
        import pxr.Usd  # type: ignore[import-not-found]
        import pxr.UsdGeom  # type: ignore[import-not-found]
        import pxr.UsdVol  # type: ignore[import-not-found]
        import pxr.Vt  # type: ignore[import-not-found]
    except ImportError:
        raise InputError("USD files need usd-core 26.3 or newer; pip install 'fidsplat[usd]'") from None
    return pxr
