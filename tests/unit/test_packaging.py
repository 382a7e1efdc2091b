"""The kernels travel: an installed wheel, an installed sdist and an editable install all find them."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]
PARTS = ("fidsplat", "kernels", "docs", "benchmarks")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", ".gitignore")
KERNELS = {
    path.relative_to(TREE / "kernels").as_posix()
    for ending in ("*.cl", "*.py")
    for path in (TREE / "kernels").rglob(ending)
}

LINKER = "fidsplat/backends/opencl/pocl_workarounds/bin/ld"

# prints the folder of the kernels and every kernel file under it
ASK = """
import sys, site
others = list(sys.path)
site.addsitedir(sys.argv[1])  # reads the .pth file of an editable install
sys.path[:] = [p for p in sys.path if p not in others] + others  # before this environment's own fidsplat
from fidsplat.util.files import kernels_folder
folder = kernels_folder()
print(folder)
for path in sorted([*folder.rglob("*.cl"), *folder.rglob("*.py")]):
    print(path.relative_to(folder).as_posix())
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the files in git, so that building writes nothing into the repository."""
    copy = tmp_path_factory.mktemp("tree")
    for name in PARTS:
        shutil.copytree(TREE / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(TREE / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def built(tree, tmp_path_factory):
    """Folder with the sdist and the wheel that was built from it, offline."""
    out = tmp_path_factory.mktemp("dist")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(tree)], out)
    return out


def run(command, folder) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=clean())
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def clean() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def install(source, target, *options):
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-compile"]
    run([*pip, "--target", target, *options, source], target)


def kernels_seen_from(target) -> tuple[Path, set[str]]:
    """Kernels that a fresh interpreter finds if ``target`` is its site-packages, without a checkout."""
    folder, *files = run([sys.executable, "-c", ASK, str(target)], target).splitlines()
    return Path(folder), set(files)


def test_an_installed_wheel_finds_the_kernels(built, tmp_path):
    (wheel,) = built.glob("*.whl")
    install(wheel, tmp_path)
    folder, files = kernels_seen_from(tmp_path)
    assert folder == tmp_path / "fidsplat" / "_kernels"
    assert files == KERNELS
    assert os.access(tmp_path / LINKER, os.X_OK)
    assert KERNELS


def test_an_installed_sdist_finds_the_kernels(built, tmp_path):
    (sdist,) = built.glob("*.tar.gz")
    install(sdist, tmp_path, "--no-build-isolation")
    folder, files = kernels_seen_from(tmp_path)
    assert folder == tmp_path / "fidsplat" / "_kernels"
    assert files == KERNELS
    assert os.access(tmp_path / LINKER, os.X_OK)


def test_an_unpacked_sdist_finds_the_kernels_without_being_installed(built, tmp_path):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (unpacked,) = tmp_path.iterdir()
    folder, files = kernels_seen_from(unpacked)
    assert folder == unpacked / "kernels"
    assert files == KERNELS
    assert (unpacked / "LICENSE").is_file()


def test_an_editable_install_finds_the_kernels(tree, tmp_path):
    # what `pip install -e .` does, less the network and a new environment: the wheel that points back at
    # the tree
    make = "import hatchling.build, sys; print(hatchling.build.build_editable(sys.argv[1]))"
    name = run([sys.executable, "-c", make, str(tmp_path)], tree).split()[-1]
    target = tmp_path / "site"
    target.mkdir()
    install(tmp_path / name, target)
    folder, files = kernels_seen_from(target)
    assert folder == tree / "kernels"
    assert files == KERNELS


def test_the_wheel_holds_the_package_and_nothing_else(built):
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"fidsplat"}
    assert any(name.endswith("entry_points.txt") for name in names)
    assert any(name.endswith("LICENSE") for name in names)
    assert "fidsplat/py.typed" in names  # type checkers of those who use it read its annotations


def test_missing_kernels_are_a_clear_error(tree, tmp_path):
    shutil.copytree(tree / "fidsplat", tmp_path / "fidsplat")
    done = subprocess.run(
        [sys.executable, "-c", ASK, str(tmp_path)], cwd=tmp_path, capture_output=True, text=True, env=clean()
    )
    assert "DeviceError: the kernels must be in" in done.stderr
