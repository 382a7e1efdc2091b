"""The inputs of hostile.py: a function for each kind, which makes one from a random generator and has fidsplat
use it. It returns a command's exit status, or None."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat import cli

LONG = "x" * 50_000

JUNK: list[Any] = [
    None, True, False, 0, -1, 1, 5, 2**31, 2**70, -(2**70), 10**400, 0.5, -0.0, 1e-320, 1e308, float("nan"),
    float("inf"), -float("inf"), "", "a", "rgb", "nan", "../..", "\0", "\ud800", "\n", "𝕏", LONG, b"", b"\xff", 1j,
    [], [1], [1, 2, 3], [[1], [2, 3]], ["a", "b", "c"], [None], [float("nan")] * 3, [1e300] * 3, (), (0, 0, 0), {},
    {1: 2}, {"rgb": 1}, {1, 2, 3}, object(), lambda *_: None, iter(()), range(3), ..., Decimal("1e999"),
    Fraction(1, 3), Path("nowhere"), slice(None), np.float32("nan"), np.int64(-5), np.bool_(True), np.array(3.0),
    np.array("text"), np.array([None]), np.zeros((0, 3)), np.zeros((3, 3, 3)), np.zeros((4, 4)), -np.eye(4), np.eye(3),
    np.full((4, 4), np.nan), np.eye(4) * 1e300, np.eye(4, dtype=complex), np.zeros((2, 2), "O"),
    np.array(["2020-01-01"], "datetime64[D]"), np.ma.masked_array([1.0], [True]),
]  # fmt: skip
"""values that nobody expects"""

NUMBERS = [
    "0",
    "-1",
    "1",
    "0.5",
    "1e308",
    "-1e308",
    "1e400",
    "nan",
    "inf",
    "-inf",
    "0x10",
    "-0.0",
    "1_0",
    "true",
    "[]",
    "{}",
    "[[1]]",
    "1979-05-27",
]
NUMBERS += ["9" * 20, "9" * 400, "9" * 5000, '""', '"a"', "[1, 2]"]
TEXTS = [
    "",
    " ",
    "\0",
    "\n",
    "\ud800",
    "\x1b[31m",
    "qr:",
    "image:",
    "image:.",
    "aruco::",
    "a,b,=",
    LONG,
    "a." * 9,
]
TEXTS += [
    "%s%n",
    "..",
    "/",
    "/dev/null",
    "/dev/zero",
    "-",
    "--",
    "'",
    '"',
    "{}",
    "rgb",
    "nan",
    "-1",
    "0",
    "1e999",
    "𝕏é",
    "=,=",
]


def scene_text(rng: Random) -> str:
    """A scene file that is good."""
    lens = rng.choice(
        ["", "[camera.distortion]\nk1 = 0.1\n", "[camera.fisheye]\nk1 = 0.01\n", "[camera.equirectangular]\n"]
    )
    view = "" if "equi" in lens else "fov_x_deg = 60.0\n"
    pose = "position = [0.0, 0.0, -1.0]\nlook_at = [0.0, 0.0, 0.0]\n"
    moves = rng.random() < 0.3
    parts = [
        f"[camera]\nwidth = 24\nheight = 16\n{view}near = 0.1\n{'' if moves else pose}",
        lens,
        rng.choice(["", "[camera.shutter]\nexposure_time_ms = 5.0\nsub_poses = 2\nreadout_ms = 3.0\nrows_per_band = 8\n"]),
        f"[[camera.motion]]\ntime = 0.0\n{pose}" if moves else "",
        '[[splats]]\nfile = "good.ply"\nposition = [0.0, 0.0, 1.0]\nquaternion = [1.0, 0.0, 0.0, 0.0]\nscale = 1.0\n',
        rng.choice(["", '[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.1\nquiet_zone = 1\nmixture = "exact"\n']),
        rng.choice(["", "[sensor]\nexposure = 1.5\nfull_well = 1000.0\nread_noise = 2.0\nresponse = 2.2\nbits = 8\n"]),
        rng.choice(["", "[fog]\ndensity = 0.1\ncolor = [0.5, 0.5, 0.5]\n"]),
        rng.choice(["", "[background]\ntop = [0.0, 0.0, 1.0]\nbottom = [1.0, 1.0, 1.0]\n", '[background]\nimage = "good.png"\n']),
        '[render]\noutputs = ["rgb", "depth"]\ndevice = "reference"\n',
        rng.choice(["", '[quality]\npreset = "fast"\nsamples = 2\nalpha_cutoff = 1e-3\n[quality.marker]\ntemplate = 9\n']),
    ]  # fmt: skip
    return "\n".join(parts)


def _ground(folder: Path) -> None:
    """Files that are good, for inputs to name and to spoil."""
    if not (folder / "good.ply").exists():
        from fidsplat.vision.images import write_png

        rng = np.random.default_rng(0)
        fs.save_ply(_cloud(12), folder / "good.ply")
        write_png(folder / "good.png", rng.integers(0, 255, (8, 16, 3)).astype(np.uint8))
        write_png(folder / "bits.png", rng.integers(0, 2, (6, 6)).astype(np.uint8) * 255)


def _cloud(n: int) -> fs.SplatCloud:
    r = np.random.default_rng(n)
    sh = r.normal(size=(n, 4, 3))
    return fs.SplatCloud(
        r.normal(size=(n, 3)), r.normal(size=(n, 4)), r.uniform(0.1, 1, (n, 2)), r.random(n), sh=sh
    )


def _spoil(rng: Random, data: bytes) -> bytes:
    """Bytes cut, turned, doubled, or exchanged."""
    for _ in range(rng.randint(1, 4)):
        at, length = rng.randrange(len(data) + 1), rng.choice([1, 4, 30, 1000])
        data = rng.choice([
            data[:at],
            data[:at] + rng.randbytes(length) + data[at + length :],
            data[:at] + bytes([rng.choice([0, 255])]) * length + data[at + length :],
            data[:at] + data[at : at + length] * 2 + data[at + length :],
            data[:at] + data[at + length :],
        ]) or b"p"  # fmt: skip
    return data


# --- command lines

COMMANDS = 2 * [
    "marker aruco:4x4_50:7 --size 0.1 -o tag.ply --mixture fitted --quality marker.template=9",
    "marker qr:hello --json",
    "marker image:bits.png --mixture exact --native-2dgs -o tag.ply",
    "render scene.toml -o frames --outputs rgb,depth,label --device reference --quality fast,samples=2",
    "render none.ply -o a.png --device reference --json",
    "detect good.png --family 36h11 --scene scene.toml --json",
    "devices --json",
] + [
    "check --device nowhere",
    "bench --scenes nothing --json out.json",
    "tradeoff --scenes nothing -o out",
    "experiment nothing -o out",
    "demo --out /proc/nowhere",
    "warm nothing --device nowhere",
]


def words(rng: Random, folder: Path) -> int:
    _ground(folder)
    (folder / "scene.toml").write_text(scene_text(rng))
    given = rng.choice(COMMANDS).split()
    slow = given[0] in ("check", "bench", "tradeoff", "experiment", "demo", "warm")
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(1, len(given) + 1)
        match rng.randrange(2 if slow else 6):
            case 0:
                given.insert(at, rng.choice(TEXTS))
            case 1:
                given.insert(
                    at, rng.choice(["--size", "--debugg", "--jsno", "-o", "--outputs", "--quality", "--seed"])
                )
            case 2:
                given[at - 1] = rng.choice(TEXTS)
            case 3:
                del given[at - 1]
            case 4:
                word = given[at - 1]
                cut = rng.randrange(len(word) + 1)
                given[at - 1] = word[:cut] + rng.choice(TEXTS)[:9] + word[cut + rng.randrange(2) :]
            case _:
                given[at - 1] = given[at - 1].replace("=", rng.choice("=,:")) + rng.choice(
                    ["", ",", "=", *NUMBERS]
                )
        given = given or [""]
    if slow:  # which would work for minutes, were its words good after all
        given.append("--debugg")
    with _inside(folder):
        return cli.main([word for word in given if word != "--debug"])


class _inside:
    """Work in a folder, with the paths of the command line relative to it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        import os

        self._before = os.getcwd()
        os.chdir(self._folder)

    def __exit__(self, *_) -> None:
        import os

        os.chdir(self._before)


# --- files


def scenes(rng: Random, folder: Path) -> None:
    _ground(folder)
    lines = scene_text(rng).split("\n")
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(len(lines))
        key, equals, value = lines[at].partition(" = ")
        match rng.randrange(9):
            case 0 | 1 | 2 if equals:
                lines[at] = f"{key} = {rng.choice(NUMBERS)}"
            case 3 if equals:
                lines[at] = f"{key} = {_quoted(rng.choice(TEXTS))}"
            case 4 if equals:
                before = rng.choice(["", "a.", ".", f"{key}.", LONG, '"" .'])
                lines[at] = f"{before}{key} = {value}"
            case 5:
                lines.insert(at, lines[rng.randrange(len(lines))])
            case 6:
                lines[at] = rng.choice([
                    "[" * 10**5, "a = " + "[" * 10**5, "a = " + "{a = " * 10**5, "a." * 10**5 + "b = 1",
                    "[" + "a." * 10**5 + "b]", "\n".join(f"a{i} = 1" for i in range(20_000)), "a = " + "1" * 10**5,
                    'a = "' + "x" * 10**6 + '"', "[[splats]]\n" * 3000, "# " + LONG, "\n".join(["[camera]"] * 2),
                    "a = '''" + LONG, "\0", "\ufeff", "outputs = " + str(["rgb"] * 10_000), "world_to_camera = [[1]]",
                    "vignetting = " + str([0.1] * 10_000), "response = " + str([0.1] * 10_000), "a = 0x" + "f" * 10**5,
                ])  # fmt: skip
            case 7:
                del lines[at]
                lines = lines or [""]
            case _:
                lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    path = folder / "hostile.toml"
    path.write_bytes(_spoil(rng, data) if rng.random() < 0.2 else data)
    scene = fs.Scene.load(path)
    if (
        scene.camera is not None
        and scene.camera.width * scene.camera.height < 10_000
        and len(scene.cloud()) < 10_000
    ):
        fs.Renderer("reference").render(scene)
    scene.save(folder / "again.toml")
    fs.Scene.load(folder / "again.toml")


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def splats(rng: Random, folder: Path) -> None:
    _ground(folder)
    head, _, data = (folder / "good.ply").read_bytes().partition(b"end_header\n")
    lines = head.split(b"\n")[:-1]
    for _ in range(rng.randrange(3)):
        at = rng.randrange(1, len(lines))
        count = rng.choice([b"0", b"1", b"13", b"4294967296", b"99999999999999999", b"-1", b"1e3", b""])
        lines[at] = rng.choice([
            b"element vertex " + count, b"element sh " + count, b"element chunk " + count, b"comment " + LONG.encode(),
            lines[at].replace(b"float", rng.choice([b"double", b"uchar", b"half", b"list uchar int"])), b"", b"\xff",
            lines[at] + b" x", lines[rng.randrange(1, len(lines))], b"property uint packed_position", b"format ascii 1.0",
            b"comment fidsplat origin 1e300 nan 1", b"comment fidsplat origin 1e300 1e300 1e300", b"property int plane",
            b"property int label", b"property float scale_2", b"property float " + LONG.encode(), b"property float x",
        ])  # fmt: skip
    path = folder / "hostile.ply"
    content = b"\n".join(lines) + b"\nend_header\n" + data
    path.write_bytes(_spoil(rng, content) if rng.random() < 0.6 else content)
    if rng.random() < 0.1:
        with path.open("r+b") as stream:  # sparse: nothing but its end is on the disk
            stream.truncate(rng.choice([10**6, 10**8, 10**12]))
    cloud = fs.load_ply(path)
    if 0 < len(cloud) < 1000:
        fs.Renderer("reference").render(
            cloud, fs.Camera.look_at(24, 16, 1.0, (0, 0, -9), (0, 0, 0)), ["rgb", "depth"]
        )
    fs.save_ply(cloud, folder / "again.ply")


def _png(width: int, height: int, depth: int, color: int, pixels: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(pixels))
        + chunk(b"IEND", b"")
    )


def pictures(rng: Random, folder: Path) -> int | None:
    _ground(folder)
    wide, high = rng.choice([1, 7, 300, 20_000, 100_000, 2**31 - 1]), rng.choice([1, 7, 300, 20_000, 100_000])
    depth, color = rng.choice([(1, 0), (8, 0), (8, 2), (16, 2), (8, 6), (16, 6), (3, 1)])
    data = rng.choice([
        lambda: (folder / "good.png").read_bytes(),
        lambda: _png(wide, high, depth, color, rng.randbytes(3000)),
        lambda: _png(wide, high, depth, color, bytes(min(wide * high, 30_000_000))),  # a bomb: zeros pack well
        lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (high, wide) + rng.randbytes(200),
        lambda: b"P%d\n%d %d\n255\n" % (rng.randint(1, 6), wide, high) + rng.randbytes(300),
        lambda: b"BM" + struct.pack("<IIIIiiHHIIiiII", 99, 0, 54, 40, wide, high, 1, 24, 0, 0, 0, 0, 0, 0) + rng.randbytes(200),
        lambda: b"v/1\x01\x02\0\0\0" + rng.randbytes(300),
        lambda: b"II*\0\x08\0\0\0\x02\0\x00\x01\x04\0\x01\0\0\0" + struct.pack("<I", wide) + rng.randbytes(100),
        lambda: rng.randbytes(rng.choice([0, 1, 50])),
    ])()  # fmt: skip
    path = folder / f"hostile{rng.choice(['.png', '.hdr', '.exr', '.jpg', '', '.tif'])}"
    path.write_bytes(_spoil(rng, data) if rng.random() < 0.5 and data else data)
    from fidsplat.vision.detect import detect
    from fidsplat.vision.images import read_bits, read_image

    def seen() -> None:
        image = read_image(path)
        if image.size < 10**6:
            detect(image)

    ways: list[Callable[[], Any]] = [
        seen,
        lambda: read_image(path, deep=True),
        lambda: read_bits(path),
        lambda: fs.Panorama.load(path),
        lambda: fs.marker(f"image:{path}", size=0.1),
        lambda: cli.main(["detect", str(path)]),
    ]
    status = rng.choice(ways)()
    return status if isinstance(status, int) else None


# --- Python


def calls(rng: Random, folder: Path) -> None:
    """A public function with one or two arguments that nobody expects, and what comes of it used."""
    _ground(folder)
    from hostile_calls import CALLS

    name = rng.choice(sorted(CALLS))
    function, good, use = CALLS[name](folder)
    given = dict(good)
    for key in rng.sample(sorted(given), min(len(given), rng.choice([1, 1, 1, 2]))):
        given[key] = rng.choice(JUNK)
    try:
        made = function(**given)
        if use is not None:
            use(made)
    except fs.FidsplatError:
        raise
    except Exception as error:
        changed = ", ".join(
            f"{key}={_short(value)}" for key, value in given.items() if value is not good[key]
        )
        error.add_note(f"{name}({changed})")
        raise


def _short(value: Any) -> str:
    return repr(value)[:60] if not isinstance(value, np.ndarray) else f"array{value.shape} of {value.dtype}"


KINDS: dict[str, Callable[[Random, Path], int | None]] = {
    "words": words,
    "scenes": scenes,
    "splats": splats,
    "pictures": pictures,
    "calls": calls,
}
