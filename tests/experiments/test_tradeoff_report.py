"""The report of `fidsplat tradeoff`: its statements follow from the numbers of the results."""

import json
import xml.dom.minidom

import pytest
import tradeoff_report as report

import fidsplat as fs
from fidsplat.capture.quality import PRESETS
from fidsplat.cli import main
from fidsplat.experiments.summary import summarise
from fidsplat.experiments.sweep import Record
from fidsplat.experiments.tradeoff import plot
from fidsplat.experiments.tradeoff.points import (
    ABLATION,
    BASE,
    EXACT,
    SETTINGS,
    Point,
    ellipsoid_points,
    points,
    preset,
)
from fidsplat.experiments.tradeoff.summary import COLUMNS, DeviceResults, load, quality_text, rows_of

RUN = {
    "device": "A processor, driver 1", "title": "A processor", "kind": "cpu", "machine": "two cores",
    "versions": {"fidsplat": "0"}, "commit": "abc", "code": "123", "seed": 0, "date": "2026-11-21",
}  # fmt: skip
GPU = {"device": "A card, driver 2", "title": "A card", "kind": "gpu"}


def result(ratio: float, maximum: float, **more) -> dict:
    return {
        "ms": 10 * ratio, "ms_quartiles": [9 * ratio, 11 * ratio], "base_ms": 10.0,
        "base_quartiles": [9.9, 10.1], "ratio": ratio, "ratio_quartiles": [0.995 * ratio, 1.005 * ratio],
        "repeats": 5, "splats": 100, "pairs": 10,
        "maximum": maximum, "rmse": maximum / 10, "maximum_sure": maximum,
    } | more  # fmt: skip


def record(scene: str, point: Point, found: dict, quick: bool = False, **run) -> Record:
    key = {"scene": scene, **point.key(), "quick": quick}
    return Record(json.loads(json.dumps(key)), found, RUN | run)


# quality setting and value -> (time, largest error); the base has 1 and 0.02
NUMBERS = {
    ("base", "base"): (1.0, 0.02),
    ("preset", "gsplat"): (1.0, 0.04),
    ("preset", "standard"): (1.3, 0.0004),
    ("preset", "reference"): (2.0, 1e-6),
    ("alpha_cutoff", "1/1024"): (1.25, 0.0015),
    ("alpha_cutoff", "0.0001"): (1.5, 0.001),
    ("alpha_cutoff", "4/255"): (0.8, 0.08),
    ("transmittance_stop", "1/512"): (0.9, 0.02),
    ("transmittance_stop", "0"): (1.2, 0.02),
    ("opacity_ceiling", "0.99"): (1.0, 0.03),
    ("projection_precision", "float32"): (1.01, 0.02),
    ("arithmetic", "fast"): (1.0, 0.002),
    ("lowpass", "none"): (0.7, 0.5),
    (ABLATION, "exact"): (2.0, 1e-6),
    (ABLATION, "alpha_cutoff 1/255"): (1.2, 0.019),
    (ABLATION, "opacity_ceiling 0.99"): (2.01, 0.01),
    (ABLATION, "transmittance_stop 0.0001"): (2.0, 1e-4),
}


def plain_records(scene: str, **run) -> list[Record]:
    actual = {(point.setting, point.value): point for point in points(SETTINGS, False)}
    return [record(scene, actual[key], result(*numbers), **run) for key, numbers in NUMBERS.items()]


def marker_records() -> list[Record]:
    records = []
    for point in points(SETTINGS, True):
        for tilt in (0, 60):
            marked = {"ideal_psnr": 30.0 + tilt / 10, "corners_px": 0.05, "rectangles": 4}
            records.append(record(f"qr10@{tilt}", point, result(1.0, 0.01, **marked)))
    return records


def thick_records() -> list[Record]:
    numbers = {"base": (1.0, 0.4), "ewa": (1.2, 0.4), "ewa_antialiased": (1.2, 0.3), "exact": (1.8, 0.01)}
    return [record("r100k_720p_3d", p, result(*numbers[p.value])) for p in ellipsoid_points(SETTINGS)]


def device(records: list[Record]) -> DeviceResults:
    return DeviceResults(summarise(records, rows_of, COLUMNS))


def write(folder, records: list[Record]) -> None:
    folder.mkdir(parents=True)
    lines = [json.dumps({"run": records[0].run})]
    for each in records:
        lines.append(json.dumps({"key": each.key, "result": each.result}))
    (folder / "tradeoff.jsonl").write_text("".join(line + "\n" for line in lines))


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (("alpha_cutoff", "1/1024"), "slower, more accurate"),
        (("alpha_cutoff", "4/255"), "faster, less accurate"),
        (("transmittance_stop", "1/512"), "faster"),
        (("transmittance_stop", "0"), "slower"),
        (("opacity_ceiling", "0.99"), "dominated"),
        (("projection_precision", "float32"), "no difference"),
        (("arithmetic", "fast"), "more accurate"),
    ],
)
def test_a_verdict_follows_from_time_and_error(setting, expected):
    table = device(plain_records("hard"))
    assert report.compared(table, table.at("hard", *setting), table.at("hard", "base", "base")) == expected


def test_times_within_the_noise_of_the_base_do_not_differ():
    records = plain_records("hard")
    records[0].result["ratio_quartiles"] = [0.7, 1.1]  # the machine was not quiet
    table = device(records)
    assert report.noise_of(table, "hard") == pytest.approx(0.3)
    base = table.at("hard", "base", "base")
    assert report.compared(table, table.at("hard", "transmittance_stop", "1/512"), base) == "no difference"
    # quartiles on both sides of 1 are no difference either
    wide = result(0.9, 0.02, ratio_quartiles=[0.8, 1.02])
    records = [*plain_records("hard"), record("hard", Point("samples", "2", BASE), wide)]
    table = device(records)
    base = table.at("hard", "base", "base")
    assert report.compared(table, table.at("hard", "samples", "2"), base) == "no difference"


def test_a_time_at_the_limit_of_the_noise_does_not_differ():
    records = plain_records("hard")
    records[0].result["ratio_quartiles"] = [0.8, 1.25]
    table = device(records)
    assert report.noise_of(table, "hard") == 0.25
    base = table.at("hard", "base", "base")
    assert report.compared(table, table.at("hard", "alpha_cutoff", "1/1024"), base) == "more accurate"
    assert report.compared(table, table.at("hard", "alpha_cutoff", "0.0001"), base) == "slower, more accurate"


def test_what_was_measured_twice_shows_the_noise():
    records = plain_records("hard")
    assert report.noise_of(device(records), "hard") == 0.02
    twice = Point(ABLATION, "reference again", preset("reference"))
    records.append(record("hard", twice, result(2.14, 1e-6)))
    assert report.noise_of(device(records), "hard") == pytest.approx(0.07)


def test_the_cheapest_invisible_error_is_the_cheapest_on_all_scenes():
    records = plain_records("hard") + plain_records("r100k_720p")
    chosen = report.cheapest_within(device(records), ("hard", "r100k_720p"), report.INVISIBLE)
    assert [point["value"] for point in chosen] == ["1/1024", "1/1024"]
    # beyond its error bounds another is invisible too, on one of the scenes
    for each in records:
        if each.key["value"] == "fast" and each.key["scene"] == "hard":
            each.result["maximum_sure"] = 0.001
    chosen = report.cheapest_within(device(records), ("hard",), report.INVISIBLE)
    assert [point["value"] for point in chosen] == ["fast"]
    assert report.cheapest_within(device(records), ("hard",), 1e-9) == []


def test_on_a_gpu_what_delays_both_frames_makes_nothing_cheaper():
    for kind, expected in (("cpu", 1.125), ("gpu", 1.25)):
        records = plain_records("hard", kind=kind)
        slow = next(each for each in records if each.key["value"] == "1/1024")
        slow.result.update(base_ms=20.0, ratio=1.125)
        measured = device(records)
        assert report.cost(measured, measured.at("hard", "alpha_cutoff", "1/1024")) == pytest.approx(expected)


@pytest.mark.sweep
def test_the_report_says_what_the_numbers_say(tmp_path):
    parts = plain_records("hard"), plain_records("r100k_720p"), marker_records(), thick_records()
    write(tmp_path / "cpu", [each for part in parts for each in part])
    write(tmp_path / "gpu", plain_records("hard", **GPU) + plain_records("r100k_720p", **GPU))
    page = tmp_path / "docs" / "accuracy.md"
    files = report.write_report([tmp_path / "cpu", tmp_path / "gpu"], page)
    assert files[0] == page
    assert {file.name for file in files[1:]} == {"cpu.csv", "cpu.svg", "gpu.csv", "gpu.svg"}
    text = page.read_text()
    for words in (
        "| alone | alpha_cutoff 1/255 | faster, less accurate | +20 % | 0.019 | - | - | +20 % | 0.019 |",
        "| alone | opacity_ceiling 0.99 | dominated | +101 % | 0.01 | - | - | +101 % | 0.01 |",
        "| alone | transmittance_stop 0.0001 | no effect | +100 % | 0.0001 | - | - | +100 % | 0.0001 |",
        "| ellipsoid | exact | slower, more accurate | - | - | +80 % | 0.01 | - | - |",
        "| lowpass | none |  | -30 % | 0.5 | - | - | -30 % | 0.5 |",
        "](accuracy/cpu.svg)",
        "](accuracy/gpu.svg)",
        "- cpu, random scenes: alpha_cutoff 1/1024 (r100k_720p +25 %)",
        "| exact | 25 | +0.0 % | 36.0 | 0.05 |",
        "[cpu.csv](accuracy/cpu.csv), [gpu.csv](accuracy/gpu.csv)",
        "| A card, 34 | A card, driver 2 | abc/123 | 2026-11-21 |",
    ):
        assert words in text, words

    # the page can be made again from its own tables, and these are small
    before = {file: file.read_bytes() for file in (tmp_path / "docs").rglob("*.*")}
    report.write_report([tmp_path / "docs" / "accuracy"], page)
    assert {file: file.read_bytes() for file in (tmp_path / "docs").rglob("*.*")} == before


def test_a_device_that_rendered_only_3d_gaussians_takes_nothing_from_the_others(tmp_path):
    write(tmp_path / "a", plain_records("r100k_720p"))
    again = [Record(each.key, each.result, each.run | {"device": "driver 2"}) for each in thick_records()]
    write(tmp_path / "b", again)
    report.write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "page.md")
    text = (tmp_path / "page.md").read_text()
    for words in (
        "| alone | alpha_cutoff 1/255 | faster, less accurate | +20 % | 0.019 |",
        "| ellipsoid | exact | slower, more accurate | +80 % | 0.01 |",
        "| A processor (cpu), 17 |",
        "| A processor (cpu-2), 4 |",
    ):
        assert words in text, words


def test_names_in_a_chart_cover_neither_each_other_nor_the_legend(tmp_path):
    every = [record("hard", point, result(1.0, 0.02)) for point in points(SETTINGS, False)]
    numbered = {**dict.fromkeys(NUMBERS), **NUMBERS}
    for each in every:
        ratio, maximum = numbered.get((each.key["setting"], each.key["value"]), (1.05, 0.02))
        each.result.update(result(ratio, maximum))
    plot.write_chart([device(every)], "hard", tmp_path / "a.svg")
    plot.write_chart([device(every)], "hard", tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    chart = xml.dom.minidom.parse(str(tmp_path / "a.svg"))
    comments = [node.data.strip() for node in walk(chart) if node.nodeType == node.COMMENT_NODE]
    assert {"standard", "gsplat", "reference", "cut-off 1/1024", "only alpha up to 0.99"} <= set(comments)


def test_devices_are_side_by_side_in_one_chart(tmp_path):
    """Of a scene that all of them have rendered."""
    write(tmp_path / "cpu", [*plain_records("hard"), *plain_records("r1m_1080p")])
    write(tmp_path / "gpu", plain_records("hard", **GPU))
    plot.write_plot([tmp_path / "cpu", tmp_path / "gpu"], tmp_path / "both.svg")
    chart = xml.dom.minidom.parse(str(tmp_path / "both.svg"))
    comments = [node.data.strip() for node in walk(chart) if node.nodeType == node.COMMENT_NODE]
    assert {"hard on A processor", "hard on A card", "half an 8-bit level"} <= set(comments)
    assert comments.count("gsplat") == 2
    write(tmp_path / "other", plain_records("r100k_720p", **GPU))
    with pytest.raises(
        fs.InputError, match="measurements of one common scene, got none of A processor, A card"
    ):
        plot.write_plot([tmp_path / "cpu", tmp_path / "other"], tmp_path / "none.svg")
    assert not (tmp_path / "none.svg").exists()


def walk(node):
    yield node
    for child in node.childNodes:
        yield from walk(child)


def test_a_preset_is_what_it_says_today(monkeypatch):
    actual = {(point.setting, point.value): point for point in points(SETTINGS, False)}
    records = [each for each in plain_records("hard") if each.key["value"] != "standard"]
    records.append(record("hard", actual["preset", "standard"], result(1.0, 0.02)))

    def standard(among):
        point = device(among).at("hard", "preset", "standard")
        return None if point is None else point["maximum"]

    assert standard(records) == 0.02
    today = BASE.with_(alpha_cutoff=1 / 1024)
    monkeypatch.setitem(PRESETS, "standard", today)
    assert standard(records) is None
    records[-1] = record("hard", Point("preset", "standard", today), result(1.2, 0.0016))
    assert standard(records) == 0.0016


def test_of_what_was_measured_twice_the_first_file_counts(tmp_path):
    write(tmp_path / "a", plain_records("hard"))
    other = plain_records("hard") + plain_records("r100k_720p")
    for each in other:
        each.result["maximum"] = 7.0
    write(tmp_path / "b", other)
    (loaded,) = load([tmp_path / "a", tmp_path / "b"])
    assert loaded.at("hard", "base", "base")["maximum"] == 0.02
    assert loaded.at("r100k_720p", "base", "base")["maximum"] == 7.0


def test_a_full_run_counts_before_a_quick_one(tmp_path):
    quick = record("hard", Point("base", "base", BASE), result(1.0, 0.03), quick=True)
    full = record("hard", Point("base", "base", BASE), result(1.0, 0.02))
    write(tmp_path / "a", [quick])
    write(tmp_path / "b", [full])
    (loaded,) = load([tmp_path / "a", tmp_path / "b"])
    assert loaded.at("hard", "base", "base")["maximum"] == 0.02


def test_refused_settings_are_named(tmp_path):
    records = plain_records("hard")
    records.append(record("hard", Point("samples", "3", EXACT), {"error": "no such samples"}))
    write(tmp_path / "a", records)
    report.write_report([tmp_path / "a"], tmp_path / "page.md")
    text = (tmp_path / "page.md").read_text()
    assert "Not rendered: samples 3 (no such samples)." in text


def test_a_few_results_are_enough(tmp_path):
    write(tmp_path / "a", plain_records("hard")[:1])
    report.write_report([tmp_path / "a"], tmp_path / "page.md")
    assert "cpu.svg" in (tmp_path / "page.md").read_text()


def test_other_results_are_refused_by_name(tmp_path):
    write(tmp_path / "a", [Record({"category": "small"}, {}, {"device": "x"})])
    with pytest.raises(fs.InputError, match="must be of fidsplat tradeoff, got those of another command"):
        load([tmp_path / "a"])
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.csv").write_text("milk,bread\n1,2\n")
    with pytest.raises(fs.InputError, match=r"notes.csv must be a summary"):
        load([tmp_path / "b"])
    for head in ("[1]", "[" * 100_000):
        (tmp_path / "b" / "notes.csv").write_text(f"# {head}\nmilk,bread\n1,2\n")
        with pytest.raises(fs.InputError, match=r"cannot read .*notes.csv"):
            load([tmp_path / "b"])


def test_a_folder_without_results_is_not_passed_over(tmp_path):
    write(tmp_path / "a", plain_records("hard"))
    with pytest.raises(fs.InputError, match=r"results must be in .*other, got none"):
        load([tmp_path / "a", tmp_path / "other"])


def test_settings_that_change_the_image_are_known():
    point = Point("order", "centre", BASE.with_(order="centre"))
    base = Point("base", "base", BASE)
    for scene in ("hard", "qr10@60"):
        records = [record(scene, one, result(1.0, 0.1)) for one in (base, point)]
        assert len(device(records).same_definition(scene)) == 1


def test_a_quality_in_words_is_the_same_for_the_same():
    point = Point("marker", "x", BASE.with_(marker={"template": 9}, alpha_cutoff=1e-5)).key()
    assert quality_text(point["quality"]) == "alpha_cutoff=1e-05 marker.template=9"
    assert quality_text(json.loads(json.dumps(point))["quality"]) == quality_text(point["quality"])
    assert quality_text({}) == "nothing"


def test_without_what_makes_reports_one_line_says_what_to_install(capsys, tmp_path, monkeypatch):
    function_path = "fidsplat.commands.options.find_spec"
    monkeypatch.setattr(function_path, lambda name: None if name == "jinja2" else True)
    assert main(["experiment", "report", str(tmp_path)]) == 2
    assert (
        "jinja2 must be installed for a report; pip install 'fidsplat[experiments]'"
        in capsys.readouterr().err
    )
