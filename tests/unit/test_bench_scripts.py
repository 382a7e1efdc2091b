"""Benchmark scripts: tables from figures, and a resumed growth run."""

import json
from pathlib import Path

import compare_images
import growth
import performance_tables as tables
import pytest
from growth import Point

from fidsplat.experiments.sweep import read_records

ROOT = Path(__file__).resolve().parents[2]
RECORD = {
    "scene": "tag",
    "renderer": "fidsplat",
    "device": "d",
    "title": "a CPU",
    "date": "2026-11-21",
    "width": 640,
    "height": 480,
    "error": None,
    "frame_ms": 1.234,
    "quartiles_ms": [1.1, 1.5],
    "stages_ms": {"project": 0.25, "blend": 0.75},
    "splats": 691,
    "visible": 690,
    "fragments": 202902,
    "splats_per_second": 5.6e5,
    "memory_bytes": 2**30,
    "rates": {"copy_bytes": 45e9, "fma": 250e9, "exp": 12.5e9, "division": 50e9},
    "times_roofline": {"blend": 15.5, "frame": 12.25},
}
PEER = RECORD | {
    "renderer": "Peer 1",
    "device": "d",
    "title": "2 threads",
    "frame_ms": 1234.0,
    "times_ours": 1000.0,
    "psnr_db": 39.7,
}
FIRST = {
    "scene": "tag",
    "device": "opencl",
    "date": "2026-11-21",
    "caches": "empty",
    "seconds": {"python": 0.01, "frame": 1.3, "total": 1.68},
    "range": [1.5, 2.0],
}

BATCH = {
    "batch": "few",
    **{"views": 64, "splats": 10000, "width": 128, "height": 96, "outputs": ["rgb", "depth"]},
    **{"device": "a CPU", "date": "2026-11-22", "us_per_view": 900.0, "quartiles_us": [800.0, 1000.0]},
    **{"alone_us_per_view": 5000.0, "stages_us": {"blend": 600.0}},
}

OTHER = {
    "device": "warp:cuda:0",
    "frame_ms": 1.851,
    "host_ms": 0.25,
    "stages_ms": {"project": 0.5, "sort": 0.25, "bin": 0.125, "blend": 1.0, "resolve": 0.5},
}

PEER_BATCH = {"outputs": ["rgb"], "us_per_view": 1800.0, "times_ours": 2.0, "psnr_same_constants_db": 69.6}


@pytest.fixture
def files(tmp_path):
    """One of each kind."""
    failed = {
        "scene": "r20m_4k",
        "renderer": "fidsplat",
        "device": "d",
        "title": "a CPU",
        "error": "no memory",
    }
    kinds = {
        "bench.json": {"results": [RECORD, failed]},
        "peer.json": {"results": [RECORD | {"frame_ms": 1.2}, PEER]},
        "backends.json": {"results": [RECORD | {"host_ms": 0.5}, RECORD | OTHER]},
        "first.json": [FIRST],
        "batches.json": [BATCH],
        "peer_batches.json": [
            BATCH | {"renderer": "fidsplat 1"},
            BATCH | PEER_BATCH | {"renderer": "Peer 1"},
        ],
    }
    for name, content in kinds.items():
        (tmp_path / name).write_text(json.dumps(content))
    times = {
        "frame_ms": 9.0,
        "stages_ms": {"blend": 9.0},
        "series": "splats",
        "device": "d",
        "title": "a CPU",
        "error": None,
    }
    curve = [
        times | {"x": x, "fastest_ms": x**0.5, "fastest_stages_ms": {"blend": x}}
        for x in (10.0, 100.0, 1000.0)
    ]
    lines = [{"run": {}}, *({"key": {"x": record["x"]}, "result": record} for record in curve)]
    (tmp_path / "growth.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return sorted(tmp_path.iterdir())


def rows(text: str) -> list[str]:
    return text.splitlines()[2:]


def test_each_kind_of_figures_becomes_its_table(files):
    pages = tables.tables(tables.load(files))
    assert list(pages) == list(tables.TABLES)
    assert rows(pages["counts"]) == ["| tag | 640 x 480 | 691 | 690 | 202,902 |"]
    assert rows(pages["rates"]) == ["| a CPU | 45 GB/s | 250 G/s | 12.5 G/s | 50 G/s |"]
    assert rows(pages["frames"]) == ["| tag | d: a CPU | 1.23 (1.1 to 1.5) | 12.2 | 0.56 M | 1 GiB |"]
    assert rows(pages["backends"]) == [
        "| tag | 1.23 (0.5) | 1.85 (0.25) | 1.50 | 0.5 (0.25) | 0.375 (0) | 1.5 (0.75) | 2026-11-21 |"
    ]
    assert rows(pages["stages"]) == ["| tag | d: a CPU | 0.25 (-) | 0.75 (15.5) |"]
    assert rows(pages["peers"]) == [
        "| tag | Peer 1, 2 threads | 1234 | a CPU: 1.2 | 1e+03 | 39.7 dB | 2026-11-21 |"
    ]
    assert rows(pages["first"]) == [
        "| tag | opencl | empty | 1.68 s (1.50 to 2.00) | 0.01 | 1.30 | 2026-11-21 |"
    ]
    assert rows(pages["batches"]) == [
        "| 64 of 128 x 96 | rgb, depth | 10,000 | a CPU | 900 (800 to 1000) | 5000 | 600 | 2026-11-22 |"
    ]
    assert rows(pages["peer_batches"]) == [
        "| 64 of 128 x 96 | 10,000 | Peer 1: rgb | 1800 "
        "| rgb, depth | batches.py's | 900 | 2 | 69.6 dB | 2026-11-22 |"
    ]
    assert rows(pages["growth"]) == ["| a CPU | splats | 0.50 | 1.00 |"]


def test_a_table_replaces_the_text_between_its_marks():
    page = "before\n<!-- begin rates -->\nold\n<!-- end rates -->\nafter\n"
    expected = "before\n<!-- begin rates -->\nnew\n<!-- end rates -->\nafter\n"
    assert tables.insert(page, "rates", "new") == expected
    assert tables.insert(expected, "rates", "new") == expected
    assert tables.insert(page, "stages", "new") == page


def test_one_page_has_a_place_for_each_table():
    pages = [page.read_text("utf-8") for page in (*ROOT.glob("docs/*.md"), *ROOT.glob("devlog/*.md"))]
    for name in tables.TABLES:
        assert sum(page != tables.insert(page, name, "new") for page in pages) == 1, name


def test_growth_goes_on_where_it_was(tmp_path, capsys):
    file = tmp_path / "growth.jsonl"
    small = [Point("splats", n, n, 0.1, 64, 48) for n in (20, 40, 80)]
    first = growth.run({"splats": small[:2]}, "opencl", 2, 60.0, file)
    assert [record["x"] for record in first] == [20, 40]
    lines = file.read_text()
    file.write_text(lines + '{"cut off')  # as a run that is killed leaves it
    again = growth.run({"splats": small}, "opencl", 2, 60.0, file)
    assert [record["x"] for record in again] == [20, 40, 80]
    assert again[:2] == first  # not measured again
    assert file.read_text().startswith(lines)
    assert [record.result for record in read_records(file)] == again
    (thick,) = growth.run(
        {"overdraw": [Point("overdraw", 2, 400, 1.0, 64, 48)]}, "opencl", 1, 60.0, tmp_path / "o"
    )
    assert thick["layers_per_pixel"] > thick["fragments"] / (64 * 48) > 1


def test_growth_stops_where_it_takes_too_long(tmp_path, capsys):
    small = [Point("splats", n, n, 0.1, 64, 48) for n in (20, 40)]
    records = growth.run({"splats": small}, "opencl", 1, 1e-9, tmp_path / "growth.jsonl")
    assert [record["x"] for record in records] == [20]
    assert "splats ends at 20" in capsys.readouterr().err


def test_images_of_two_trees_are_compared_by_their_digests(monkeypatch, capsys):
    assert len(compare_images.frames()) == 146
    actual = [
        {"a": "1", "b": "2", "c": "refused: so"},
        {"a": "1", "b": "refused: why", "c": "refused: other"},
    ]
    monkeypatch.chdir("/")  # not the tree of this script
    monkeypatch.setattr(compare_images, "digests_of_tree", lambda tree, *_: actual[tree != Path("/")])
    monkeypatch.setattr("sys.argv", ["compare_images.py", "."])
    assert compare_images.main() == 1
    out = capsys.readouterr().out
    assert out.startswith("differs: b\n  refused: why\n")
    assert out.endswith("3 frames on opencl: 1 identical, 1 refused by both\n")
    actual[1]["b"] = "2"
    assert compare_images.main() == 0
    actual[:] = {}, {}
    with pytest.raises(SystemExit):
        compare_images.main()


def test_the_digest_of_a_frame_depends_on_its_outputs(monkeypatch):
    some = {name: given for name, given in compare_images.frames().items() if name.startswith("output ")}
    monkeypatch.setattr(compare_images, "frames", lambda: some)
    actual = compare_images.digests("opencl", "output depth")
    assert set(actual) == {"output depth", "output depth_first", "output depth_median"}
    assert len(set(actual.values())) == 3
    monkeypatch.setattr(compare_images, "cloud", lambda seed: compare_images.fs.SplatCloud.empty())
    assert not set(actual.values()) & set(compare_images.digests("opencl", "output depth").values())
