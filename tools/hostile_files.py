"""Files that are good but for some changes, for hostile_inputs.py: scenes, splats, pictures, drawings,
results."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import fidsplat as fs
from fidsplat import cli

LONG = "x" * 50_000
NUMBERS = [
    "0", "-1", "1", "0.5", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "0x10", "-0.0", "1_0", "true", "[]", "{}",
    "[[1]]", "1979-05-27", "9" * 20, "9" * 400, "9" * 5000, '""', '"a"', "[1, 2]",
]  # fmt: skip
"""what a number may be exchanged for"""
TEXTS = [
    "", " ", "\0", "\n", "\ud800", "\x1b[31m", "qr:", "image:", "image:.", "svg:.", "aruco::", "a,b,=", LONG, "a." * 9,
    "%s%n", "..", "/", "/dev/null", "/dev/zero", "-", "--", "'", '"', "{}", "rgb", "nan", "-1", "0", "1e999", "𝕏é", "=,=",
]  # fmt: skip
"""texts that nobody expects"""


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
        rng.choice([
            "",
            '[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.1\nquiet_zone = 1\nmixture = "exact"\n',
            '[[markers]]\nspec = "charuco:3x3:4x4_50"\nsize = 0.1\nlabel = 3\n',
            '[[markers]]\nspec = "svg-9:good.svg"\nsize = 0.1\n',
        ]),
        rng.choice(["", "[sensor]\nexposure = 1.5\nfull_well = 1000.0\nread_noise = 2.0\nresponse = 2.2\nbits = 8\n"]),
        rng.choice(["", "[fog]\ndensity = 0.1\ncolor = [0.5, 0.5, 0.5]\n"]),
        rng.choice(["", "[background]\ntop = [0.0, 0.0, 1.0]\nbottom = [1.0, 1.0, 1.0]\n", '[background]\nimage = "good.png"\n']),
        '[render]\noutputs = ["rgb", "depth"]\ndevice = "reference"\n',
        rng.choice(["", '[quality]\npreset = "fast"\nsamples = 2\nalpha_cutoff = 1e-3\norder = "pixel"\n[quality.marker]\ntemplate = 9\n']),
    ]  # fmt: skip
    return "\n".join(parts)


def ground(folder: Path) -> None:
    """Files that are good, for inputs to name and to spoil."""
    if not (folder / "good.ply").exists():
        from fidsplat.images.files import write_png

        rng = np.random.default_rng(0)
        fs.save_ply(_cloud(12), folder / "good.ply")
        write_png(folder / "good.png", rng.integers(0, 255, (8, 16, 3)).astype(np.uint8))
        (folder / "good.svg").write_text(drawing_text(Random(0)))
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


def scenes(rng: Random, folder: Path) -> None:
    ground(folder)
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
    ground(folder)
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
    ground(folder)
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
    from fidsplat.images.files import read_bits, read_image
    from fidsplat.vision.detect import detect

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


DRAWN = [
    '<rect x="1" y="2" width="3" height="4" fill="#123456"/>',
    '<circle cx="5" cy="5" r="3" fill="rgb(255, 0, 9)"/>',
    '<ellipse cx="5" cy="5" rx="3" ry="2"/>',
    '<polygon points="0,0 9,0 9,9" fill-rule="evenodd"/>',
    '<path d="M 1 1 h 5 v 5 l -1 1 C 1 2 3 4 5 6 S 1 2 3 4 Q 1 2 3 4 T 5 6 A 2 3 10 0 1 4 4 z" style="fill:navy"/>',
    '<g transform="translate(1, 2) rotate(30) scale(0.5)"><rect width="4" height="4"/></g>',
    '<g fill="none"><title>a</title><rect width="9" height="9" fill="lime"/></g>',
]


def drawing_text(rng: Random) -> str:
    """An SVG file that is good."""
    shapes = "\n".join(rng.choices(DRAWN, k=rng.randint(1, 6)))
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10">\n{shapes}\n</svg>\n'


def drawings(rng: Random, folder: Path) -> None:
    """Numbers and words of a drawing exchanged, tags doubled and nested, bytes spoiled."""
    text = drawing_text(rng)
    for _ in range(rng.choice([1, 1, 2, 3])):
        match rng.randrange(6):
            case 0 | 1 | 2:
                spots = [*re.finditer(r"[-0-9.]+" if rng.random() < 0.7 else r"\w+", text)]
                spot = rng.choice(spots)
                text = text[: spot.start()] + rng.choice(NUMBERS + TEXTS) + text[spot.end() :]
            case 3:
                line = rng.choice(text.split("\n"))
                text = text.replace(line, line * rng.choice([2, 1000]), 1)
            case 4:
                deep = rng.choice([2, 99, 10_000])
                text = text.replace("<g", "<g>" * deep + "<g", 1).replace("</g>", "</g>" + "</g>" * deep, 1)
            case _:
                text = rng.choice([
                    '<!DOCTYPE a [<!ENTITY b "cccccccccc"><!ENTITY d "&b;&b;&b;&b;&b;&b;">]>' + text.replace("10", "&d;"),
                    '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + text.replace("10", "&b;"),
                    text.replace("svg", "html"), text.replace(' xmlns="http://www.w3.org/2000/svg"', ""),
                    text.replace("0 0 10 10", rng.choice(["0 0 1e-300 1e300", "0 0 1e300 1e-300", "0 0 1 1e9", "1 2 3"])),
                    text.replace("fill", rng.choice(["stroke", "opacity", "mask", "transform", "display"])),
                ])  # fmt: skip
    path = folder / "hostile.svg"
    data = text.encode("utf-8", "surrogatepass")
    path.write_bytes(_spoil(rng, data) if rng.random() < 0.2 else data)
    spec = f"svg{rng.choice(['', '', '-1', '-16', '-2048', '-0', '-99999'])}:{path}"
    made = fs.marker(spec, size=0.1, mixture="exact")
    if len(made.cloud) < 1000:
        fs.Renderer("reference").render(made.cloud, fs.Camera.look_at(24, 16, 1.0, (0, 0, -1), (0, 0, 0)))


def results(rng: Random, folder: Path) -> None:
    """Results and their summaries with values exchanged, lines doubled and bytes spoiled."""
    from fidsplat.experiments.results import load
    from fidsplat.experiments.sweep import merge
    from fidsplat.experiments.targets import targets

    place = folder / "results"
    place.mkdir(exist_ok=True)
    for path in place.iterdir():
        path.unlink()
    name = rng.choice(["counts", "angles", "views", "localisation"])
    lines = (Path(__file__).parents[1] / "devlog" / "results" / f"{name}.csv").read_text().split("\n")
    lines = lines[:2] + rng.sample(lines[2:-1], 12) + [""]
    raw = rng.random() < 0.5
    if raw:
        run = {"run": {"device": None, "seed": 0, "versions": {}, "code": "", "points": 1}}
        part = {"dark": 3, "light": 4}
        found = {key: part for key in ("cells", "runs", "rectangles", "components")}
        found |= {"gaussians": {"exact": {"rectangles": 7, "cells": 8}}, "seconds": {"exact": [0.1, 0.2]}}
        point = {"key": {"category": "apriltag", "index": 0, "repeats": 2}, "result": found}
        lines = [json.dumps(run), json.dumps(point), ""]
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(len(lines))
        spots = [*re.finditer(r"[-0-9.]+" if rng.random() < 0.7 else r"\w+", lines[at])]
        match rng.randrange(5):
            case 0 | 1 | 2 if spots:
                spot = rng.choice(spots)
                lines[at] = lines[at][: spot.start()] + rng.choice(NUMBERS + TEXTS) + lines[at][spot.end() :]
            case 3:
                lines.insert(at, rng.choice([*lines, "{}", "[]", "null", "{" * 10**5, "# {}", "#"]))
            case _:
                del lines[at]
                lines = lines or [""]
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    file = place / ("counts-1-of-2.jsonl" if raw else f"{name}.csv")
    file.write_bytes(_spoil(rng, data) if rng.random() < 0.2 and data else data)
    if raw and rng.random() < 0.5:
        merge([file], place / "counts.jsonl")
    targets(load([place]))
