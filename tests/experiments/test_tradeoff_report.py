"""The report of `fidsplat tradeoff`: its words follow from the numbers of the lines."""

import json
import xml.dom.minidom

import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.experiments.document import Document
from fidsplat.experiments.scatter import Axis, Dot, scatter_chart
from fidsplat.experiments.tradeoff.points import ALONE, BASE, EXACT, KNOBS, Point, decode_points, points
from fidsplat.experiments.tradeoff.report import verdicts
from fidsplat.experiments.tradeoff.report.plots import pareto_chart
from fidsplat.experiments.tradeoff.report.reading import report_reading
from fidsplat.experiments.tradeoff.report.results import Results, load
from fidsplat.quality import PRESETS

RUN = {
    "device": "A processor, driver 1", "title": "A processor", "kind": "cpu", "machine": "two cores",
    "versions": {"fidsplat": "0"}, "commit": "abc", "code": "123", "seed": 0, "date": "2026-11-21",
}  # fmt: skip


def result(ratio: float, maximum: float, **more) -> dict:
    return {
        "ms": 10 * ratio, "ms_quartiles": [9 * ratio, 11 * ratio], "base_ms": 10.0,
        "base_quartiles": [9.9, 10.1], "ratio": ratio, "ratio_quartiles": [0.995 * ratio, 1.005 * ratio],
        "repeats": 5, "stages_ms": {}, "memory_bytes": 2**20, "splats": 100, "pairs": 10,
        "maximum": maximum, "p999": maximum / 2, "rmse": maximum / 10, "psnr": 40.0,
        "maximum_sure": maximum, "flip": 0.01, "flip_of": "all",
    } | more  # fmt: skip


def line(scene: str, point: Point, found: dict, **run) -> dict:
    key = {"what": "point", "scene": scene, **point.key(), "quick": False}
    return {"key": json.loads(json.dumps(key)), "result": found, "run": RUN | run}


# knob and value -> (time, largest error); the base has 1 and 0.02
NUMBERS = {
    ("base", "base"): (1.0, 0.02),
    ("preset", "gsplat"): (1.0, 0.04),
    ("preset", "reference"): (2.0, 1e-6),
    ("alpha_cutoff", "1/1024"): (1.25, 0.0015),
    ("alpha_cutoff", "0.0001"): (1.5, 0.001),
    ("alpha_cutoff", "4/255"): (0.8, 0.08),
    ("transmittance_stop", "1/512"): (0.9, 0.02),
    ("transmittance_stop", "0"): (1.2, 0.02),
    ("opacity_ceiling", "0.99"): (1.0, 0.03),
    ("setup_precision", "float32"): (1.01, 0.02),
    ("arithmetic", "fast"): (1.0, 0.002),
    ("lowpass", "none"): (0.7, 0.5),
    (ALONE, "exact"): (2.0, 1e-6),
    (ALONE, "alpha_cutoff 1/255"): (1.2, 0.019),
    (ALONE, "opacity_ceiling 0.99"): (2.01, 0.01),
}


def plain_lines(scene: str, **run) -> list[dict]:
    found = {(point.knob, point.value): point for point in points(KNOBS, False)}
    return [line(scene, found[key], result(*numbers), **run) for key, numbers in NUMBERS.items()]


def marker_lines() -> list[dict]:
    lines = []
    for point in decode_points(KNOBS)[:4]:
        for tilt in (0, 60, 80):
            marked = {
                "ideal_psnr": 30.0 + tilt / 10,
                "ideal_maximum": 0.4,
                "corners_px": 0.05,
                "rectangles": 4,
            }
            lines.append(line(f"qr10@{tilt}", point, result(1.0, 0.01, **marked)))
        key = {"what": "decode", "scene": "qr10", **point.key(), "tilts": "0:80:20"}
        scan = {"reader": "zxing", "read": "11101", "splats": 100, "rectangles": 4}
        lines.append({"key": json.loads(json.dumps(key)), "result": scan, "run": RUN})
    ideal = {"what": "decode", "scene": "qr10", "knob": "ideal", "value": "ideal", "quality": None}
    scan = {"reader": "zxing", "read": "11110", "splats": None, "rectangles": 4}
    lines.append({"key": ideal | {"tilts": "0:80:20"}, "result": scan, "run": RUN})
    return lines


def write(folder, lines) -> None:
    folder.mkdir()
    (folder / "tradeoff.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))


@pytest.mark.parametrize(
    ("setting", "wanted"),
    [
        (("alpha_cutoff", "1/1024"), verdicts.BOUGHT),
        (("alpha_cutoff", "4/255"), verdicts.CHEAPER),
        (("transmittance_stop", "1/512"), verdicts.FASTER),
        (("transmittance_stop", "0"), verdicts.WASTE),
        (("opacity_ceiling", "0.99"), verdicts.TRAP),
        (("setup_precision", "float32"), verdicts.NOTHING),
        (("arithmetic", "fast"), verdicts.FREE),
    ],
)
def test_a_verdict_follows_from_time_and_error(setting, wanted):
    results = Results("d", plain_lines("hard"))
    point, base = results.points["hard", *setting], results.base("hard")
    assert verdicts.verdict(point, base, verdicts.noise(results, "hard")) == wanted


def test_times_within_the_noise_of_the_base_do_not_differ():
    lines = plain_lines("hard")
    lines[0]["result"]["ratio_quartiles"] = [0.7, 1.1]  # the machine was not quiet
    results = Results("d", lines)
    least = verdicts.noise(results, "hard")
    assert least == pytest.approx(0.3)
    point = results.points["hard", "transmittance_stop", "1/512"]
    assert verdicts.verdict(point, results.base("hard"), least) == verdicts.NOTHING
    one_side = result(0.9, 0.02, ratio_quartiles=[0.8, 1.02])
    noisy = line("hard", Point("arithmetic", "fast", BASE), one_side)
    assert verdicts.time_sign(Results("d", [noisy]).points["hard", "arithmetic", "fast"], 0.02) == 0


def test_what_was_measured_twice_shows_the_noise():
    lines = plain_lines("hard")
    assert verdicts.noise(Results("d", lines), "hard") == verdicts.TIME_CHANGES
    lines.append(line("hard", Point("alone", "reference again", PRESETS["reference"]), result(2.14, 1e-6)))
    assert verdicts.noise(Results("d", lines), "hard") == pytest.approx(0.07)


def test_the_front_has_nothing_that_is_beaten():
    results = Results("d", plain_lines("hard"))
    front = verdicts.front(point for point in results.of("hard") if point.same_picture)
    assert [point.words for point in front] == [
        "alpha_cutoff 4/255", "transmittance_stop 1/512", "arithmetic fast", "alpha_cutoff 1/1024",
        "alpha_cutoff 0.0001", "reference",
    ]  # fmt: skip


def test_the_cheapest_invisible_error_is_the_cheapest_on_all_scenes():
    lines = plain_lines("hard") + plain_lines("r100k_720p")
    chosen = verdicts.cheapest_within(Results("d", lines), ("hard", "r100k_720p"), verdicts.INVISIBLE)
    assert {point.words for point in chosen or ()} == {"alpha_cutoff 1/1024"}
    # beyond its certificates the other is invisible too, on one of the scenes
    for each in lines:
        if each["key"]["knob"] == "arithmetic" and each["key"]["scene"] == "hard":
            each["result"]["maximum_sure"] = 0.001
    chosen = verdicts.cheapest_within(Results("d", lines), ("hard",), verdicts.INVISIBLE)
    assert {point.words for point in chosen or ()} == {"arithmetic fast"}
    assert verdicts.cheapest_within(Results("d", lines), ("hard",), 1e-9) is None


def test_on_a_gpu_what_delays_both_frames_makes_nothing_cheaper():
    lines = plain_lines("hard")
    slow = next(line for line in lines if line["key"]["value"] == "1/1024")
    ratio = slow["result"]["ratio"]
    slow["result"] |= {"base_ms": 2 * slow["result"]["base_ms"], "ratio": (1 + ratio) / 2}
    for kind, wanted in (("cpu", (1 + ratio) / 2), ("gpu", ratio)):
        for line in lines:
            line["run"]["kind"] = kind
        results = Results("d", lines)
        assert results.cost(results.at("hard", "alpha_cutoff", "1/1024")) == pytest.approx(wanted)


def test_the_report_says_what_the_numbers_say(capsys, tmp_path):
    write(tmp_path / "cpu", [*plain_lines("hard"), *plain_lines("r100k_720p"), *marker_lines()])
    gpu = {"device": "A card, driver 2", "title": "A card", "kind": "gpu"}
    write(tmp_path / "gpu", plain_lines("hard", **gpu))
    page = tmp_path / "docs" / "accuracy.md"
    words = ["tradeoff", "report", str(tmp_path / "cpu"), str(tmp_path / "gpu"), "-o", str(page), "--json"]
    assert main(words) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files[0] == str(page)
    assert {name.rpartition("/")[2] for name in files[1:]} == {
        "pareto-hard-cpu.svg", "pareto-r100k_720p-cpu.svg", "pareto-qr10-60-cpu.svg", "pareto-hard-gpu.svg",
        "markers-psnr-cpu.svg", "markers-angle-cpu.svg",
    }  # fmt: skip
    for name in files[1:]:
        xml.dom.minidom.parse(name)
    text = page.read_text()
    assert text.index("## A processor, driver 1") < text.index("## A card, driver 2")
    for words in (
        "**Free accuracy**: arithmetic fast.",
        "**Free time**: transmittance_stop 1/512.",
        "**Traps**: gsplat; opacity_ceiling 0.99.",
        "traps: opacity_ceiling 0.99; free time: none; buying time on some scene: alpha_cutoff 1/255;",
        "**Waste**: transmittance_stop 0.",
        "**No difference** on any scene: setup_precision float32.",
        "alpha_cutoff 1/1024 (r100k_720p +25 %, error / 13; hard +25 %, error / 13)",
        "the base took r100k_720p 10.00 to 10.00 ms, median 10.00; hard 10.00 to 10.00 ms, median 10.00.",
        "| hard | at gsplat's error at least as fast | 0.900 of its time | transmittance_stop 1/512 | yes |",
        "| hard | in gsplat's time 10 times as accurate | 20 times | arithmetic fast | yes |",
        "on random scenes: alpha_cutoff 1/1024 (r100k_720p +25 %, error 0.0015)",
        "| 1/255: nothing fainter is drawn | -40 % | 0.019 | 0.0019 |",
        "| lowpass none | -30 % | 0.5 * | 0.05 * |",
        "The ideal texture is read up to 60 degrees.",
        "| base | 25.0 | +0.0 % / +0.0 % / +0.0 % | 30.0 / 36.0 / 38.0 | 0.05 / 0.05 / 0.05 |",
        "| 0.01 / 0.01 / 0.01 | 40 |",
        "](accuracy/pareto-hard-gpu.svg)",
    ):
        assert words in text, words


def test_what_is_free_on_one_scene_and_bought_on_another_is_worth_turning():
    lines = plain_lines("r100k_720p") + plain_lines("hard")
    for each in lines:
        if (each["key"]["scene"], each["key"]["value"]) == ("hard", "1/1024"):
            each["result"] |= result(1.0, 0.0015)
    document = Document("t")
    report_reading(document, Results("d", lines))
    assert (
        "**Worth turning** for accuracy: alpha_cutoff 1/1024 (r100k_720p +25 %, error / 13; hard +0.0 %, "
        "error / 13); "
    ) in document.markdown()


def test_a_run_that_was_disturbed_says_so():
    lines = plain_lines("hard")
    lines[3]["result"]["base_ms"] = 17.0  # a busy host, and the base beside itself was drawn at another time
    document = Document("t")
    report_reading(document, Results("d", lines))
    assert "the base took hard 10.00 to 17.00 ms, median 10.00." in document.markdown()


def test_a_preset_is_what_it_says_today(monkeypatch):
    found = {(point.knob, point.value): point for point in points(KNOBS, False)}
    lines = plain_lines("hard")
    lines.append(line("hard", found["preset", "standard"], result(1.0, 0.02)))

    def standard(among):
        point = Results("d", among).at("hard", "preset", "standard")
        return point and (point.maximum, point.words)

    assert standard(lines) == (0.02, "standard")
    today = BASE.with_(alpha_cutoff=1 / 1024)
    monkeypatch.setitem(PRESETS, "standard", today)
    assert standard(lines) == (0.0015, "standard")  # as measured by another name
    assert standard(lines[-1:]) is None
    lines.append(line("hard", Point("preset", "standard", today), result(1.2, 0.0016)))
    assert standard(lines) == (0.0016, "standard")


def test_no_two_kinds_of_dots_have_one_colour():
    every = [line("hard", point, result(1.0, 0.02)) for point in points(KNOBS, False)]
    chart = xml.dom.minidom.parseString(pareto_chart(Results("d", every), "hard"))
    boxes = chart.getElementsByTagName("rect")
    colours = [box.getAttribute("fill") for box in boxes if box.getAttribute("width") == "10"]
    assert len(colours) > 5
    assert len(set(colours)) == len(colours)


def test_of_what_was_measured_twice_the_first_file_counts(tmp_path):
    write(tmp_path / "a", plain_lines("hard"))
    other = plain_lines("hard") + plain_lines("r100k_720p")
    for each in other:
        each["result"]["maximum"] = 7.0
    write(tmp_path / "b", other)
    (results,) = load([tmp_path / "a", tmp_path / "b"])
    assert results.base("hard").maximum == 0.02
    assert results.base("r100k_720p").maximum == 7.0
    assert len(results.lines) == 2 * len(NUMBERS)


def test_a_full_run_counts_before_a_quick_one():
    quick = line("hard", Point("base", "base", BASE), result(1.0, 0.02))
    quick["key"]["quick"] = True
    full = line("hard", Point("base", "base", BASE), result(1.0, 0.02, repeats=30))
    for lines in ([quick, full], [full, quick]):
        assert Results("d", lines).base("hard").result["repeats"] == 30


def test_refused_settings_are_told(tmp_path):
    lines = plain_lines("hard")
    lines.append(line("hard", Point("arithmetic", "fast", EXACT), {"error": "no such arithmetic"}))
    write(tmp_path / "a", lines)
    assert main(["tradeoff", "report", str(tmp_path / "a")]) == 0
    assert (
        "Not drawn by this device: arithmetic fast (no such arithmetic)."
        in (tmp_path / "a" / "report.md").read_text()
    )


def test_other_results_are_refused_by_name(tmp_path):
    other = {"key": {"category": "small"}, "result": {}, "run": {"device": "x"}}
    write(tmp_path / "a", [other])
    with pytest.raises(fs.InputError, match="holds no results of fidsplat tradeoff"):
        load([tmp_path / "a"])


def test_a_folder_without_results_is_not_passed_over(tmp_path):
    write(tmp_path / "a", plain_lines("hard"))
    with pytest.raises(fs.InputError, match=r"no results in .*other"):
        load([tmp_path / "a", tmp_path / "other"])


def test_a_setting_knows_whether_it_draws_another_picture():
    point = Point("coplanar", "order", BASE.with_(coplanar="order"))
    on_hard = Results("d", [line("hard", point, result(1.0, 0.1))]).points["hard", "coplanar", "order"]
    on_marker = Results("d", [line("qr10@0", point, result(1.0, 0.1))]).points["qr10@0", "coplanar", "order"]
    assert on_hard.same_picture  # no coplanar splats there
    assert not on_marker.same_picture


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_scatter_chart_puts_more_to_the_right_and_up(logarithmic):
    series = {"a": [Dot(1.0, 2.0, "low"), Dot(100.0, 50.0, "high")], "b": [Dot(10.0, 10.0)]}
    axis = Axis("x", logarithmic)
    text = scatter_chart("title <", axis, axis, series, series["a"])
    document = xml.dom.minidom.parseString(text)
    dots = [
        (float(circle.getAttribute("cx")), float(circle.getAttribute("cy")))
        for circle in document.getElementsByTagName("circle")
    ]
    (low, high, middle) = dots
    assert low[0] < middle[0] < high[0]
    assert low[1] > middle[1] > high[1]
    if logarithmic:
        assert middle[0] == pytest.approx((low[0] + high[0]) / 2, abs=0.2)
    for words in ("title &lt;", "a", "b", "low", "high"):
        assert f">{words}</text>" in text


def test_a_scatter_chart_needs_dots_that_its_axes_can_hold():
    with pytest.raises(ValueError, match="at least one dot"):
        scatter_chart("t", Axis("x"), Axis("y"), {"a": []})
    with pytest.raises(ValueError, match="at or below 0"):
        scatter_chart("t", Axis("x", True), Axis("y"), {"a": [Dot(0.0, 1.0)]})
