"""`fidsplat marker`, and the splat files that commands write."""

import os

import numpy as np
from command_line import fails, prints_json

import fidsplat as fs
from fidsplat.capture.quality import LADDER
from fidsplat.cli import main
from fidsplat.images.files import write_png


def test_marker_says_what_it_is_made_of(capsys, tmp_path):
    file = tmp_path / "new" / "tag.ply"
    facts = prints_json(capsys, "marker", "apriltag:36h11:5", "--size", "0.16", "-o", file)
    marker = fs.marker("apriltag:36h11:5", size=0.16)
    assert facts["shape"] == [8, 8]
    assert facts["components"] == marker.components
    assert sum(facts["rectangles"].values()) == len(marker.rectangles)
    assert facts["splats"] == len(marker.cloud) == len(marker.boxes)
    assert facts["mixture"] == "exact"
    assert facts["written"] == {"mixture": "fitted", "splats": len(marker.gaussians)}
    assert len(marker.gaussians) == len(fs.load_ply(file))
    assert facts["size_m"] == 0.16
    assert 0 < facts["seconds"] < 30
    assert main(["marker", "apriltag:36h11:5"]) == 0
    assert "rectangles" in capsys.readouterr().out


def test_splats_that_are_there_are_replaced_on_request(capsys, tmp_path):
    mine, other = tmp_path / "mine.ply", tmp_path / "other.ply"
    mine.write_bytes(b"a scan of months")
    other.write_bytes(b"another")
    os.link(mine, tmp_path / "the same.ply")
    for words, why in (
        (("marker", "qr:a", "-o", mine), f"{mine} already exists; give another name, or --overwrite"),
        (("convert", other, mine), f"{mine} already exists; give another name, or --overwrite"),
        (("train", tmp_path, "-o", mine), f"{mine} already exists; give another name, or --overwrite"),
        (("convert", tmp_path / "nowhere/lod-meta.json", mine), "cannot read"),
        (("convert", tmp_path / "nowhere.ply", mine, "--overwrite"), "cannot read"),
        (("convert", mine, mine), f"OUT must be another file than IN, got {mine}"),
        (("convert", mine, tmp_path / "the same.ply", "--overwrite"), "OUT must be another file than IN"),
    ):
        status, line = fails(capsys, *words)
        assert (status, mine.read_bytes()) == (2, b"a scan of months"), words
        assert why in line
    prints_json(capsys, "marker", "qr:a", "-o", mine, "--overwrite")
    prints_json(capsys, "convert", mine, other, "--overwrite", "--no-pictures")
    assert len(fs.load_ply(other)) == len(fs.load_ply(mine)) > 0


def test_a_marker_is_refined_on_a_device(capsys, tmp_path):
    words = ("marker", "aruco:4x4_50:7", "--mixture", "refined", "--iterations", "2", "--device", "opencl")
    facts = prints_json(capsys, *words, "-o", tmp_path / "tag.ply")
    more = fs.marker("aruco:4x4_50:7", mixture="fitted", template=LADDER)
    assert facts["mixture"] == "refined"
    assert facts["written"] == {"mixture": "refined", "splats": len(more.cloud)}
    assert len(fs.load_ply(tmp_path / "tag.ply")) == len(more.cloud)
    few = prints_json(capsys, *words, "--quality", "marker.template=5")
    assert few["splats"] < len(more.cloud)
    status, line = fails(capsys, "marker", "aruco:4x4_50:7", "--iterations", "2")
    assert status == 2
    assert "--mixture refined" in line


def test_a_marker_of_more_splats_than_allowed(capsys, tmp_path):
    bits = np.random.default_rng(0).random((350, 350)) < 0.5
    spec = f"image:{write_png(tmp_path / 'noise.png', bits)}"
    status, line = fails(capsys, "marker", spec, "--mixture", "fitted")
    assert status == 2
    assert "at most 1,000,000 splats" in line
    assert "--max-splats" in line
    facts = prints_json(capsys, "marker", "qr:a", "--max-splats", "10000000")
    assert facts["splats"] > 0


def test_marker_writes_two_scales_on_request(capsys, tmp_path):
    for words, scales in (([], 3), (["--native-2dgs"], 2)):
        overwrite = ["-o", str(tmp_path / "tag.ply"), "--overwrite"]
        assert main(["marker", "apriltag:36h11:5", *overwrite, *words]) == 0
        assert (tmp_path / "tag.ply").read_bytes().count(b"property float scale_") == scales
    capsys.readouterr()
    status, line = fails(capsys, "marker", "apriltag:36h11:5", "--native-2dgs")
    assert status == 2
    assert "-o FILE.ply" in line


def test_marker_with_the_mixture_of_the_paper(capsys):
    assert prints_json(capsys, "marker", "qr:hello", "--mixture", "paper")["mixture"] == "paper"


def test_marker_with_shape_and_wear(capsys, tmp_path):
    words = ("--shape", "cylinder,radius=0.05,axis=x", "--wear", "fading=0.3,seed=2")
    facts = prints_json(capsys, "marker", "apriltag:16h5:5", "--size", "0.16", *words)
    marker = fs.marker("apriltag:16h5:5", 0.16, shape=words[1], wear=words[3])
    assert facts["splats"] == len(marker.cloud) > len(marker.boxes)
    assert facts["surface"] == {"kind": "cylinder", "radius": 0.05, "axis": "x"}
    assert facts["wear"] == {"fading": 0.3, "seed": 2}
    for option, value, message in (
        ("--shape", "cylinder,radius=0.01", "radius must be at least 0.2122 m for a sheet of 1.333 m"),
        ("--wear", "dirt=2", "dirt must be a severity from 0 to 1, got 2.0"),
    ):
        status, error = fails(capsys, "marker", "apriltag:16h5:5", option, value)
        assert status == 2
        assert message in error
