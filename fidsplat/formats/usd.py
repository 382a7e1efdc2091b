"""Reading and writing of OpenUSD splats (extra `usd`): ParticleField with the Gaussian surflet kernel for 2D
splats, ParticleField3DGaussianSplat for 3D Gaussians. Schemas: openusd.org, usdVol.

Written stages have y up: splats are unchanged below a rotation by 180 degrees about x. Labels and coplanar
groups are the attributes fidsplat:labels and fidsplat:planes.

Damaged files make usd-core crash, hang or allocate gigabytes. Therefore a child process with limits of memory
and processor time reads the file.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.formats.plain import (
    HALF_TURN,
    cloud_of,
    coefficients,
    refuse_boxes,
    three_scales,
    world_means,
)
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError, bytes_words, required_package
from fidsplat.util.files import atomic_path, open_input, regular_file, utf8_path
from fidsplat.util.limits import VARIABLE, input_limit

_SURFLET = "ParticleFieldKernelGaussianSurfletAPI"
_KINDS = ("ParticleField", "ParticleField3DGaussianSplat")
_SECONDS = 30
"""limit of processor time in seconds; one second more for each MiB of the file"""
_REFUSED = 3
"""exit status of the child process after it printed the message of an InputError"""
_CHILD = (
    "import sys; sys.path[:] = sys.argv[4:]; from fidsplat.formats.usd import _child; _child(*sys.argv[1:4])"
)


def load_usd(path: Path) -> SplatCloud:
    """Read all Gaussian particle fields of a .usda, .usdc or .usd file as one cloud.

    Raises:
        InputError: the file is damaged, has no Gaussian particle field, or has an unknown kernel; reading
            crashed or exceeded `input_limit`; or the extra is missing.
    """
    with open_input(path) as stream:
        status = os.fstat(stream.fileno())
    limit = input_limit(min(status.st_size, 512 * status.st_blocks))
    with tempfile.TemporaryDirectory() as folder, utf8_path(path) as name:
        arrays = Path(folder, "arrays.npz")
        words = [str(limit), str(name), str(arrays), *sys.path]
        done = interrupts.run([sys.executable, "-c", _CHILD, *words])
        if done.returncode == _REFUSED:
            raise InputError(f"{path}: {done.stdout}")
        if done.returncode != 0:
            raise InputError(
                f"{path} must be a USD file that usd-core reads with {bytes_words(limit)} of memory, got "
                f"exit status {done.returncode} of its process; if you trust it, set {VARIABLE}={4 * limit}"
            )
        with np.load(arrays, allow_pickle=False) as stored:
            arrays_by_name = dict(stored)
    clouds = []
    for k in range(len([name for name in arrays_by_name if name.startswith("matrix")])):
        names = ("means", "quats", "scales", "opacities", "sh", "labels", "coplanar_groups")
        fields: dict[str, Any] = {name: arrays_by_name.get(f"{name} {k}") for name in names}
        cloud = cloud_of(path, **fields)
        matrix = arrays_by_name[f"matrix {k}"]
        clouds.append(cloud if np.abs(matrix - np.eye(4)).max() < 1e-12 else cloud.transformed(matrix))
    return clouds[0] if len(clouds) == 1 else SplatCloud.concatenate(clouds)


def _child(limit: str, source: str, target: str) -> None:
    """Convert a USD file to an .npz file of arrays; runs in a child process.

    limit: bytes of memory in addition to the memory of the libraries.
    """
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"  # stacks of threads count towards the limit
    try:
        pxr = _pxr()
        _set_limits(int(limit), _SECONDS + os.stat(source).st_size // 2**20)
        _check_layers(pxr, source)
        np.savez(target, **_read(pxr, source))
    except MemoryError:
        raise
    except Exception as error:  # errors of USD, which reads arrays lazily
        text = str(error) if isinstance(error, InputError) else _unreadable(source)
        sys.stdout.buffer.write(text.encode("ascii", "backslashreplace"))
        sys.stdout.flush()
        os._exit(_REFUSED)  # skip USD's finalizers, which can crash on a damaged stage


def _unreadable(source: str) -> str:
    with open(source, "rb") as stream:
        head = stream.read(16)
    version = head.partition(b"\n")[0].decode("latin-1")
    if head.startswith(b"PXR-USDC"):
        version = "PXR-USDC " + ".".join(map(str, head[8:11]))
    return f"not a USD file that usd-core can read, got {version!r}; convert a later version by usdcat"


def _set_limits(limit: int, seconds: int) -> None:
    """Limit memory (in addition to its current size) and processor time of this process, where supported."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        pages = int(Path("/proc/self/statm").read_bytes().split()[0])
        max_bytes = min(pages * resource.getpagesize() + limit, 2**62)
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        if soft == resource.RLIM_INFINITY or max_bytes < soft:
            resource.setrlimit(resource.RLIMIT_AS, (max_bytes, hard))


def _check_layers(pxr: Any, source: str) -> None:
    """Check that all files that layers reference are regular files, before USD opens them."""
    todo, known = [source], {source}
    while todo:
        layer = pxr.Sdf.Layer.FindOrOpen(todo.pop())
        for name in layer.GetCompositionAssetDependencies() if layer else ():
            file = layer.ComputeAbsolutePath(name)
            if file not in known and os.path.lexists(file):
                todo.append(str(regular_file(file)))
                known.add(file)


def _read(pxr: Any, name: str) -> dict[str, Any]:
    """Arrays of all particle fields of the file; each name ends with the index of its field."""
    stage = pxr.Usd.Stage.Open(name, pxr.Usd.Stage.LoadAll)
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() in _KINDS]
    if not prims:
        raise InputError("the stage must have a ParticleField, got none")
    up = HALF_TURN if pxr.UsdGeom.GetStageUpAxis(stage) == "Y" else np.eye(4)
    metres = pxr.UsdGeom.GetStageMetersPerUnit(stage) if stage.HasAuthoredMetadata("metersPerUnit") else 1.0
    arrays_by_field = {}
    for k, prim in enumerate(prims):
        # USD multiplies row vectors
        placed = np.array(pxr.UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T
        matrix = np.diag([metres, metres, metres, 1.0]) @ up @ placed
        arrays = {"matrix": matrix, **_field(prim)}
        arrays_by_field |= {f"{name} {k}": array for name, array in arrays.items()}
    return arrays_by_field


def save_usd(cloud: SplatCloud, path: Path) -> None:
    """Write a .usda, .usdc or .usd file. Raises InputError for boxes or a file that cannot be written."""
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
        scales[:, 2] = 1.0  # the kernel has no extent along z
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
    integers = {"labels": cloud.labels if cloud.labels.any() else None, "planes": cloud.coplanar_groups}
    for name, numbers in integers.items():
        if numbers is not None:
            attribute = prim.CreateAttribute(f"fidsplat:{name}", pxr.Sdf.ValueTypeNames.IntArray, True)
            attribute.Set(vt.IntArray.FromNumpy(numbers))
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
            raise InputError(f"cannot write {path} with usd-core; check that the disk has free space")


def _field(prim: Any) -> dict[str, np.ndarray]:
    """Arguments of `cloud_of` from a particle field."""
    surflet = _SURFLET in prim.GetAppliedSchemas()
    if prim.GetTypeName() == _KINDS[0] and not surflet:
        raise InputError(f"the kernel of {prim.GetPath()} must be the Gaussian surflet, got another kernel")

    def array(name: str, *columns: int) -> np.ndarray:
        stored = prim.GetAttribute(name).Get() or prim.GetAttribute(f"{name}h").Get()  # h: half precision
        if stored is None:
            raise InputError(f"{prim.GetPath()} must have {name}, got none")
        values = np.array(stored, np.float32)
        if values.shape[1:] != columns or values.ndim != 1 + len(columns):
            raise InputError(
                f"{name} of {prim.GetPath()} must have the shape n x {columns}, got {values.shape}"
            )
        return values

    means, scales = array("positions", 3), array("scales", 3)
    if surflet:
        scales[:, 2] = 0
    degree = int(prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() or 0)
    sh = array("radiance:sphericalHarmonicsCoefficients", 3)
    n, k = len(means), (degree + 1) ** 2
    if len(sh) != n * k:
        raise InputError(f"{prim.GetPath()} must have {n * k} SH coefficients, got {len(sh)}")
    fields = {"means": means, "scales": scales, "sh": sh.reshape(n, k, 3), "opacities": array("opacities")}
    fields["quats"] = array("orientations", 4)[:, [3, 0, 1, 2]]  # USD stores w last
    for name, attribute in (("labels", "labels"), ("coplanar_groups", "planes")):
        if (numbers := prim.GetAttribute(f"fidsplat:{attribute}").Get()) is not None:
            fields[name] = np.array(numbers, np.int32)
    return fields


def _pxr() -> Any:
    with required_package("usd-core 26.3 or newer", "usd"):
        import pxr.Gf  # type: ignore[import-not-found]
        import pxr.Sdf  # type: ignore[import-not-found]
        import pxr.Tf  # type: ignore[import-not-found]
        import pxr.Usd  # type: ignore[import-not-found]
        import pxr.UsdGeom  # type: ignore[import-not-found]
        import pxr.UsdVol  # type: ignore[import-not-found]
        import pxr.Vt  # type: ignore[import-not-found]
    return pxr
