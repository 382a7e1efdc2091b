"""Names of devices, and the repair of PoCL's target processor."""

import ctypes
from types import SimpleNamespace

import pytest

import fidsplat as fs
from fidsplat.backends.opencl import pocl_target
from fidsplat.errors import UnknownDeviceError

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
    from fidsplat.backends.opencl import device as backend

    def card(platform, name, available=True):
        return SimpleNamespace(
            platform=SimpleNamespace(name=platform), name=name, vendor="", type=0, available=available
        )

    pocl = "Portable Computing Language"
    found = [card(pocl, "a"), card("NVIDIA CUDA", "b"), card(pocl, "c"), card("NVIDIA CUDA", "d")]
    found.append(card("NVIDIA CUDA", "e"))
    monkeypatch.setattr(backend, "_all_devices", lambda: iter(found))
    monkeypatch.setattr(backend, "_why_unusable", lambda device: "" if device.available else "broken")
    monkeypatch.setattr(backend, "OpenCLBackend", lambda device: device.name)
    wanted = {"pocl": "a", "nvidia": "b", "pocl-2": "c", "nvidia-2": "d", "NVIDIA-3 ": "e"}
    assert list(backend._named_devices()) == [
        *("opencl:pocl", "opencl:nvidia", "opencl:pocl-2", "opencl:nvidia-2", "opencl:nvidia-3")
    ]
    assert {name: backend.open_device(name) for name in wanted} == wanted
    assert [backend._name_of(device) for device in found] == list(backend._named_devices())
    with pytest.raises(UnknownDeviceError, match="opencl:nvidia-3: e"):
        backend.open_device("nvidia-4")
    # without a number the first that works; with one just that
    found[0] = card(pocl, "a", available=False)
    assert backend.open_device("pocl") == "c"
    found[0], found[2] = card(pocl, "a"), card(pocl, "c", available=False)
    with pytest.raises(fs.DeviceError, match="broken"):
        backend.open_device("pocl-2")


def test_no_platform_says_how_to_get_one(monkeypatch):
    from fidsplat.backends.opencl import device as backend

    monkeypatch.setattr(backend, "_all_devices", lambda: iter(()))
    with pytest.raises(fs.DeviceError, match=r"pip install 'pyopencl\[pocl\]'"):
        fs.Renderer("opencl")


def test_target_is_corrected_only_where_the_record_looks_as_expected():
    triplet = ctypes.create_string_buffer(b"x86_64-unknown-linux-gnu")
    generic, other = ctypes.create_string_buffer(b"generic"), ctypes.create_string_buffer(b"skylake")
    Record = ctypes.c_uint64 * 512

    def record(*words):
        return Record(*words)

    good = record(1, 2, ctypes.addressof(triplet), ctypes.addressof(generic), 5)
    name = pocl_target.correct_target(ctypes.addressof(good), POCL + "generic")
    assert name in [level for level, _ in pocl_target._LEVELS]
    assert ctypes.string_at(good[3]) == name.encode()
    assert list(good[:3]) == [1, 2, ctypes.addressof(triplet)]
    assert good[4] == 5

    for bad in (
        record(ctypes.addressof(triplet), ctypes.addressof(other)),
        record(ctypes.addressof(generic), ctypes.addressof(triplet)),
        record(8, 1 << 63),
    ):
        before = list(bad)
        assert pocl_target.correct_target(ctypes.addressof(bad), POCL + "generic") is None
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
def test_only_pocl_that_mistakes_the_processor_is_corrected(monkeypatch, processor, llvm, needed):
    monkeypatch.setattr(pocl_target, "_processor_name", lambda: processor)
    assert pocl_target.needs_correction(POCL + llvm) == needed
    assert not pocl_target.needs_correction("OpenCL 3.0 CUDA")
