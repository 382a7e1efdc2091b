"""SOG files: reading, and errors."""

import json
import math
import zipfile

import cv2
import numpy as np
import pytest
from test_formats import some

import fidsplat as fs
from fidsplat.formats.files import stored_bytes
from fidsplat.formats.sog import _clustered


def picture(kind: str, side: int) -> bytes:
    return cv2.imencode(kind, np.zeros((side, side, 4), np.uint8))[1].tobytes()


def sog(path, **changes):
    """A SOG file by hand: two splats in images of 2 x 2, and a palette of SH of degree 1."""
    book = np.linspace(-4, 4, 256)
    red = lambda rows: np.array(rows, np.uint8).reshape(2, 2, -1)  # noqa: E731
    nothing = [0, 0, 0, 255]
    images = {
        "l.webp": red([[0, 0, 255, 255], [255, 0, 0, 255], nothing, nothing]),
        "u.webp": red([[128, 0, 255, 255], [255, 128, 0, 255], nothing, nothing]),
        "s.webp": red([[64, 96, 128, 255], [0, 0, 0, 255], nothing, nothing]),
        "q.webp": red([[128, 128, 128, 252], [255, 0, 128, 254], nothing, nothing]),
        "c.webp": red([[128, 0, 255, 51], [128, 128, 128, 255], nothing, nothing]),
        "n.webp": red([[65, 0, 0, 255], [1, 0, 0, 255], nothing, nothing]),
        "p.webp": np.arange(2 * 192 * 4, dtype=np.uint32).reshape(2, 192, 4).astype(np.uint8),
    }
    images["p.webp"][:, :, 3] = 255
    meta = {
        "version": 2, "count": 2,
        "means": {"mins": [-1, -2, 0], "maxs": [1, 2, 3], "files": ["l.webp", "u.webp"]},
        "scales": {"codebook": book.tolist(), "files": ["s.webp"]},
        "quats": {"files": ["q.webp"]},
        "sh0": {"codebook": book.tolist(), "files": ["c.webp"]},
        "shN": {"count": 66, "bands": 1, "codebook": book.tolist(), "files": ["p.webp", "n.webp"]},
    }  # fmt: skip
    for name, values in changes.items():
        (images if name.endswith("webp") else meta)[name] = values
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, image in images.items():
            data = image
            if isinstance(image, np.ndarray):
                bgra = cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA)
                data = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
            if data is not None:
                archive.writestr(name, data)
    return book, images["p.webp"]


def test_a_sog_file_by_hand(tmp_path):
    book, palette = sog(tmp_path / "a.sog")
    cloud = fs.load_splats(tmp_path / "a.sog")
    x, y = -1 + 2 * 0x8000 / 65535, -2 + 4 * 0x8000 / 65535
    places = [[math.expm1(x), -math.expm1(2), math.expm1(3)], [math.expm1(1 + 0 * x), math.expm1(y), 0]]
    np.testing.assert_allclose(cloud.means, places, atol=1e-6)
    np.testing.assert_allclose(cloud.scales[0], np.exp(book[[64, 96]]), rtol=1e-6)
    np.testing.assert_allclose(cloud.thickness[0], np.exp(book[128]), rtol=1e-6)
    np.testing.assert_allclose(cloud.opacities, [0.2, 1], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh[0, 0], book[[128, 0, 255]], rtol=1e-6)
    # entry 65 is the second of the second row, entry 1 the second of the first
    np.testing.assert_allclose(cloud.sh[0, 1:], book[palette[1, 3:6, :3]], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh[1, 1:], book[palette[0, 3:6, :3]], rtol=1e-6)
    tiny, half = (2 * 128 / 255 - 1) / math.sqrt(2), math.sqrt(0.5)
    np.testing.assert_allclose(cloud.quats[0], [1, tiny, tiny, tiny], atol=1e-4)
    np.testing.assert_allclose(cloud.quats[1], [half, -half, 0, tiny], atol=3e-3)  # y was left out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": 3}, "the version of SOG must be 1 or 2, got 3; convert it with splat-transform"),
        ({"version": 1}, r"damaged \(KeyError"),
        ({"count": 5}, "l.webp must have a pixel for each of 5 splats, got 4"),
        ({"sh0": {}}, r"damaged \(KeyError"),
        ({"q.webp": None}, "must have q.webp, got none"),
        ({"q.webp": b"RIFF"}, "must be an image with 8 bits per channel"),
        (
            {"q.webp": np.full((2, 2, 4), 251, np.uint8)},
            "the alpha of a rotation must be 252 to 255, got 251",
        ),
        (
            {"n.webp": np.full((2, 2, 4), 255, np.uint8)},
            "SH labels must be less than 128, the palette's size, got 65535",
        ),
        (
            {"p.webp": np.full((2, 64, 4), 255, np.uint8)},
            "the width of p.webp must be 192 pixels for 1 bands, got 64",
        ),
        ({"count": math.inf}, r"damaged \(OverflowError"),
        ({"means": "nothing"}, r"damaged \(TypeError"),
        # small files of huge images
        ({"q.webp": np.zeros((300, 300, 4), np.uint8)}, "q.webp must have about 2 pixels, got 90000"),
        ({"q.webp": picture(".png", 300)}, "q.webp must have about 2 pixels, got 90000"),
        ({"p.webp": np.zeros((2600, 192, 4), np.uint8)}, "p.webp must have about 196608 pixels, got 499200"),
        ({"q.webp": picture(".bmp", 2)}, "must be an image with 8 bits per channel"),
    ],
)
def test_damaged_sog_files(tmp_path, changes, words):
    sog(tmp_path / "a.sog", **changes)
    with pytest.raises(fs.InputError, match=words):
        fs.load_splats(tmp_path / "a.sog")
    (tmp_path / "a.sog").write_bytes((tmp_path / "a.sog").read_bytes()[:-30])
    with pytest.raises(fs.InputError, match="as SOG: its zip file is damaged"):
        fs.load_splats(tmp_path / "a.sog")


def test_a_sog_folder_of_version_1(tmp_path):
    """Equidistant values between limits in place of code books, and logits in place of opacities."""
    limits = lambda n: {"mins": [-2.0] * n, "maxs": [3.0] * n}  # noqa: E731
    scalar = {"mins": -1.0, "maxs": 1.0}
    _, palette = sog(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path)
    meta = json.loads((tmp_path / "meta.json").read_text())
    del meta["version"], meta["count"]
    meta["means"]["shape"] = [2, 3]
    meta["scales"] = limits(3) | {"files": ["s.webp"]}
    meta["sh0"] = limits(4) | {"files": ["c.webp"]}
    meta["shN"] = scalar | {"files": ["p.webp", "n.webp"]}
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    cloud = fs.load_splats(tmp_path / "meta.json")
    np.testing.assert_array_equal(cloud.means, fs.load_splats(tmp_path / "a.sog").means)
    np.testing.assert_allclose(np.log(cloud.scales[0]), -2 + 5 * np.array([64, 96]) / 255, rtol=1e-5)
    np.testing.assert_allclose(cloud.sh[0, 0], -2 + 5 * np.array([128, 0, 255]) / 255, rtol=1e-5)
    np.testing.assert_allclose(cloud.opacities[0], 1 / (1 + math.exp(2 - 5 * 51 / 255)), rtol=1e-5)
    np.testing.assert_allclose(cloud.sh[0, 1:], palette[1, 3:6, :3] / 255.0 * 2 - 1, atol=1e-6)
    for name in ("../a.sog", "/etc/hostname", "\0", "none.webp"):
        meta["quats"]["files"] = [name]
        (tmp_path / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(fs.InputError, match=r"must be in its folder|cannot read"):
            fs.load_splats(tmp_path / "meta.json")


@pytest.mark.parametrize("name", ["b.sog", "meta.json"])
def test_sog_files_that_are_written(tmp_path, name):
    cloud = some(count=300, degree=3)
    fs.save_splats(cloud, tmp_path / name)
    again = fs.load_splats(tmp_path / name)
    np.testing.assert_allclose(again.means, cloud.means, rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(np.log(again.scales), np.log(cloud.scales), atol=0.05)
    np.testing.assert_array_equal(np.asarray(again.thickness) == 0, np.asarray(cloud.thickness) == 0)
    np.testing.assert_allclose(again.opacities, cloud.opacities, atol=0.002)
    np.testing.assert_allclose(again.sh, cloud.sh, atol=0.03)
    assert np.abs((again.quats * cloud.quats).sum(1)).min() > 1 - 1e-4
    assert stored_bytes(tmp_path / name) == sum(file.stat().st_size for file in tmp_path.iterdir())
    written = (tmp_path / name).read_bytes()
    fs.save_splats(cloud, tmp_path / name)
    assert (tmp_path / name).read_bytes() == written


def test_a_palette_of_sh_has_at_most_65536_entries(monkeypatch):
    monkeypatch.setattr("fidsplat.formats.sog.MAX_ENTRIES", 64)
    vectors = np.random.default_rng(3).normal(size=(1000, 9))
    means, labels = _clustered(vectors)
    assert len(means) == 64
    assert np.bincount(labels).min() >= 15
    assert ((vectors - means[labels]) ** 2).mean() < 0.6 * vectors.var()


@pytest.mark.parametrize("way", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_sog_file_whose_parts_are_damaged(tmp_path, way):
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", way) as archive:
        archive.writestr("meta.json", json.dumps({"version": 2, "words": list(range(500))}))
    data = bytearray(path.read_bytes())
    data[60:90] = bytes(30)
    path.write_bytes(data)
    with pytest.raises(fs.InputError, match="its zip file is damaged"):
        fs.load_splats(path)


def test_a_sog_file_that_says_nothing_or_too_much(tmp_path, monkeypatch):
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", "[]")
    with pytest.raises(fs.InputError, match=r"damaged \(AttributeError"):
        fs.load_splats(path)
    monkeypatch.setattr("fidsplat.formats.sog.MAX_META", 1)
    with pytest.raises(fs.InputError, match=r"meta.json must have at most 1 bytes, got 2"):
        fs.load_splats(path)


@pytest.mark.parametrize(("spare", "fits"), [(0, True), (-1, False)])
def test_images_may_have_twice_the_pixels_that_are_meant(tmp_path, monkeypatch, spare, fits):
    """At that size exactly: two splats in images of 2 x 2."""
    monkeypatch.setattr("fidsplat.formats.sog.SPARE", spare)
    sog(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    printed = json.loads(parts.pop("meta.json"))
    del printed["shN"]  # its palette has another size
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps(printed))
        for name, data in parts.items():
            archive.writestr(name, data)
    if fits:
        assert len(fs.load_splats(tmp_path / "a.sog")) == 2
    else:
        with pytest.raises(fs.InputError, match=r"l.webp must have about 2 pixels, got 4"):
            fs.load_splats(tmp_path / "a.sog")
