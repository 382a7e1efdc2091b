"""Names of devices, and the repair of PoCL's target processor."""

import ctypes
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

import fidsplat as fs
from fidsplat.backends import registry
from fidsplat.backends.opencl import device, vendors
from fidsplat.backends.opencl.pocl_workarounds import target_patch
from fidsplat.util.errors import UnknownDeviceError

POCL = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-"


def test_devices_lists_pocl_and_the_reference():
    names = [info.name for info in fs.devices()]
    assert "opencl:pocl" in names
    assert "reference" in names


def test_pocl_is_usable_with_float64():
    pocl = next(info for info in fs.devices() if info.name == "opencl:pocl")
    assert pocl.usable, pocl.reason
    assert pocl.float64
    assert pocl.kind == "cpu"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("openc", ["'openc'", "'opencl'", "reference"]),
        ("", ["''", "opencl"]),
        ("opencl:no-such-card", ["'no-such-card'", "there are"]),
        ("reference:fast", ["'fast'"]),
    ],
)
def test_unknown_devices_are_named(name, words):
    with pytest.raises(UnknownDeviceError) as caught:
        fs.Renderer(name)
    assert all(word in str(caught.value) for word in words)
    assert caught.value.exit_status == 2


def test_devices_of_one_name_are_numbered(monkeypatch):
    """Two PoCLs in one process, or two cards of one platform: each can be typed."""

    def card(platform, name, available=True):
        return SimpleNamespace(
            platform=SimpleNamespace(name=platform),
            name=name,
            vendor="",
            type=0,
            available=available,
            version="",
        )

    pocl = "Portable Computing Language"
    cards = [card(pocl, "a"), card("NVIDIA CUDA", "b"), card(pocl, "c"), card("NVIDIA CUDA", "d")]
    cards.append(card("NVIDIA CUDA", "e"))
    monkeypatch.setattr(device, "_all_devices", lambda: iter(cards))
    monkeypatch.setattr(device, "_why_unusable", lambda one: "" if one.available else "broken")
    monkeypatch.setattr(device, "OpenCLBackend", lambda one: one.name)
    expected = {"pocl": "a", "nvidia": "b", "pocl-2": "c", "nvidia-2": "d", "NVIDIA-3 ": "e"}
    assert list(device._named_devices()) == [
        *("opencl:pocl", "opencl:nvidia", "opencl:pocl-2", "opencl:nvidia-2", "opencl:nvidia-3")
    ]
    assert {name: device.open_device(name) for name in expected} == expected
    assert [device._name_of(each) for each in cards] == list(device._named_devices())
    with pytest.raises(UnknownDeviceError, match="opencl:nvidia-3: e"):
        device.open_device("nvidia-4")
    # without a number the first that works; with one just that
    cards[0] = card(pocl, "a", available=False)
    assert device.open_device("pocl") == "c"
    cards[0], cards[2] = card(pocl, "a"), card(pocl, "c", available=False)
    with pytest.raises(fs.DeviceError, match="broken"):
        device.open_device("pocl-2")


def test_platforms_are_matched_before_devices_and_processors_never(monkeypatch):
    """Every driver for a processor repeats the processor's name."""

    def card(platform, name, kind, vendor=""):
        return SimpleNamespace(
            platform=SimpleNamespace(name=platform), name=name, vendor=vendor, type=kind, version=""
        )

    cpu, gpu = device.cl.device_type.CPU, device.cl.device_type.GPU
    pocl = card("Portable Computing Language", "cpu-Intel(R) Xeon(R)", cpu, "GenuineIntel")
    other = card("Clover", "Intel Arc by Clover", gpu)
    intel = card("Intel(R) OpenCL", "Intel(R) Xeon(R)", cpu)
    platforms = [pocl, other, intel]
    monkeypatch.setattr(device, "_all_devices", lambda: iter(platforms))
    monkeypatch.setattr(device, "_why_unusable", lambda one: "")
    monkeypatch.setattr(device, "OpenCLBackend", lambda one: one)
    assert device.open_device("intel") is intel
    assert device.open_device("arc") is other
    assert device.open_device("cpu") is pocl
    platforms.pop()
    assert device.open_device("Intel") is other
    platforms.pop()
    with pytest.raises(UnknownDeviceError, match="no OpenCL device matches 'intel'; there are: opencl:pocl"):
        device.open_device("intel")


@pytest.mark.parametrize("warp", [True, False])
def test_without_opencl_the_default_is_warp_and_says_so(monkeypatch, warp):
    def refuse(selector):
        raise fs.DeviceError("no OpenCL platform found")

    def open_warp(selector):
        if not warp:
            raise fs.DeviceError("Warp is not installed")
        return SimpleNamespace(info=SimpleNamespace(name="warp:cpu"))

    families = {"opencl": SimpleNamespace(open_device=refuse), "warp": SimpleNamespace(open_device=open_warp)}
    monkeypatch.setattr(registry, "import_module", lambda name: families[name.split(".")[2]])
    monkeypatch.delenv("FIDSPLAT_DEVICE", raising=False)
    if warp:
        with pytest.warns(UserWarning, match="no OpenCL platform found; warp:cpu is used instead"):
            assert fs.Renderer().device.name == "warp:cpu"
    else:
        with pytest.raises(fs.DeviceError, match="no OpenCL platform found; Warp is not installed"):
            fs.Renderer()
    with pytest.raises(fs.DeviceError, match=r"no OpenCL platform found$"):
        fs.Renderer("opencl")


def test_no_platform_says_how_to_get_one(monkeypatch):
    monkeypatch.setattr(device, "_all_devices", lambda: iter(()))
    with pytest.raises(fs.DeviceError, match=r"pip install 'pyopencl\[pocl\]'"):
        fs.Renderer("opencl")


def test_target_is_corrected_only_where_the_record_looks_as_expected():
    triplet = ctypes.create_string_buffer(b"x86_64-unknown-linux-gnu")
    generic, other = ctypes.create_string_buffer(b"generic"), ctypes.create_string_buffer(b"skylake")
    Record = ctypes.c_uint64 * 512

    def record(*words):
        return Record(*words)

    good = record(1, 2, ctypes.addressof(triplet), ctypes.addressof(generic), 5)
    assert target_patch.why_unpatchable(ctypes.addressof(good), POCL + "generic") == ""
    name = target_patch.patch_target(ctypes.addressof(good), POCL + "generic")
    assert name in [level for level, _ in target_patch._LEVELS]
    assert ctypes.string_at(good[3]) == name.encode()
    assert list(good[:3]) == [1, 2, ctypes.addressof(triplet)]
    assert good[4] == 5

    for bad in (
        record(ctypes.addressof(triplet), ctypes.addressof(other)),
        record(ctypes.addressof(generic), ctypes.addressof(triplet)),
        record(8, 1 << 63),
    ):
        before = list(bad)
        assert "not that of PoCL 3.0" in target_patch.why_unpatchable(ctypes.addressof(bad), POCL + "generic")
        assert target_patch.patch_target(ctypes.addressof(bad), POCL + "generic") == "generic"
        assert list(bad) == before


@pytest.mark.parametrize(
    ("processor", "llvm", "needed"),
    [
        ("skylake-avx512", "skylake-avx512", False),
        ("haswell", "znver3", False),
        ("skylake-avx512", "znver3", True),  # Zen 4: kernels for Zen 3 with a library for AVX-512 never build
        ("haswell", "generic", True),
    ],
)
def test_only_pocl_that_mistakes_the_processor_is_patched(monkeypatch, processor, llvm, needed):
    monkeypatch.setattr(target_patch, "_processor_name", lambda: processor)
    assert target_patch.needs_patch(POCL + llvm) == needed
    assert not target_patch.needs_patch("OpenCL 3.0 CUDA")


def pocl_that_mistakes(record):
    return SimpleNamespace(
        platform=SimpleNamespace(name="Portable Computing Language"), name="a PoCL", vendor="", type=0,
        available=True, compiler_available=True, endian_little=True, version=POCL + "generic",
        int_ptr=ctypes.addressof(record),
    )  # fmt: skip


@pytest.fixture
def record(monkeypatch):
    """Device record of a PoCL that does not recognise the processor; its attribute keeps the strings
    alive."""
    words = [ctypes.create_string_buffer(text) for text in (b"x86_64-unknown-linux-gnu", b"generic")]
    addresses = (ctypes.c_uint64 * 512)(*map(ctypes.addressof, words))
    addresses.kept = words
    monkeypatch.setattr(target_patch, "_patched", {})  # of records that had its address before
    return addresses


def test_what_needs_no_patch_is_preferred(monkeypatch, record):
    intel = pocl_that_mistakes(record)
    intel.platform, intel.name = SimpleNamespace(name="Intel(R) OpenCL"), "an Intel"
    intel.version = "OpenCL 3.1 (Build 0)"
    monkeypatch.setattr(device, "_all_devices", lambda: iter([pocl_that_mistakes(record), intel]))
    monkeypatch.setattr(device, "OpenCLBackend", lambda opened: opened.name)
    assert device.open_device() == "an Intel"
    assert device.open_device("pocl") == "a PoCL"
    assert list(device._named_devices()) == ["opencl:pocl", "opencl:intel"]


@pytest.mark.parametrize(("way", "named"), [("variable", target_patch.FORBID), ("hidden", "/proc/self/mem")])
def test_where_the_patch_may_not_or_cannot_be_made_another_device_is_taken_or_a_remedy_reported(
    monkeypatch, record, way, named
):
    pocl, other = pocl_that_mistakes(record), pocl_that_mistakes(record)
    other.name, other.version = "a newer PoCL", "OpenCL 3.0 PoCL HSTR: cpu-x86_64-pc-linux-gnu-haswell"
    monkeypatch.setattr(device, "OpenCLBackend", lambda opened: opened.name)
    if way == "variable":
        monkeypatch.setenv(target_patch.FORBID, "1")
    else:

        def refuse(path, flags):
            raise PermissionError(13, "Permission denied", path)

        monkeypatch.setattr(target_patch.os, "open", refuse)
    before = list(record)
    monkeypatch.setattr(device, "_all_devices", lambda: iter([pocl]))
    with pytest.raises(fs.DeviceError, match=rf"a PoCL: .*{named}.*pocl-opencl-icd") as caught:
        device.open_device()
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(device, "_all_devices", lambda: iter([pocl, other]))
    assert device.open_device() == "a newer PoCL"
    assert target_patch.patch_target(pocl.int_ptr, pocl.version) == "generic"
    assert list(record) == before


def test_the_loader_sees_the_runtime_that_pip_installed(monkeypatch, tmp_path):
    library, system = tmp_path / "lib" / "libintelocl.so", tmp_path / "vendors"
    system.mkdir()
    (system / "card.icd").write_text("libcard.so\n")
    monkeypatch.delenv(vendors._VENDORS, raising=False)
    monkeypatch.setattr(vendors, "_SYSTEM", system)
    monkeypatch.setattr(vendors, "intel_library", lambda: library)
    with vendors.intel_registered():
        folder = Path(os.environ[vendors._VENDORS])
        assert {file.read_text().strip() for file in folder.iterdir()} == {"libcard.so", str(library)}
    assert vendors._VENDORS not in os.environ
    assert not folder.exists()
    monkeypatch.setenv(vendors._VENDORS, str(system))
    with vendors.intel_registered():
        assert os.environ[vendors._VENDORS] == str(system)
    monkeypatch.delenv(vendors._VENDORS)
    monkeypatch.setattr(vendors, "intel_library", lambda: None)
    with vendors.intel_registered():
        assert vendors._VENDORS not in os.environ
