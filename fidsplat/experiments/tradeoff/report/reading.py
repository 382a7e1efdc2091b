"""What to make of the numbers: sentences and tables that are worked out from them."""

from __future__ import annotations

import math

from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING
from fidsplat.experiments.tradeoff.points import ALONE, PRESETS_KNOB
from fidsplat.experiments.tradeoff.report import verdicts
from fidsplat.experiments.tradeoff.report.results import Measured, Results
from fidsplat.experiments.tradeoff.report.wording import fixed, listed, number, percent
from fidsplat.experiments.tradeoff.scenes import HARD, is_marker

GSPLAT = (PRESETS_KNOB, "gsplat")
_EQUAL_TIME = 1.02
_MORE_ACCURATE = 10.0
_BETTER = {verdicts.BOUGHT, verdicts.FREE}


def report_reading(document: Document, results: Results) -> None:
    """Which knobs are free, which are worth turning, which are traps, on one device."""
    scenes = [scene for scene in results.scenes if not is_marker(scene)]
    if not scenes:
        return
    found = _verdicts(results, scenes)
    groups = {
        "**Free accuracy**": [s for s, v in found.items() if _only(v, verdicts.FREE)],
        "**Free time**": [s for s, v in found.items() if _only(v, verdicts.FASTER)],
        "**Traps**": [s for s, v in found.items() if _is_trap(v)],
        "**Waste**": [s for s, v in found.items() if _only(v, verdicts.WASTE)],
        "**No difference** on any scene": [
            s for s, v in found.items() if set(v.values()) == {verdicts.NOTHING}
        ],
    }
    for title, settings in groups.items():
        document.text(f"{title}: {listed([_words(results, setting) for setting in settings])}.")
    document.text(f"**Worth turning** for accuracy: {listed(_bargains(results, scenes, found))}.")
    constants = _constants(results, scenes)
    if constants:
        document.text(f"**Constants alone in an exact picture**: {_sorted_out(constants)}.")
    noises = ", ".join(f"{scene} {verdicts.noise(results, scene):.1%}" for scene in scenes)
    meanings = "; ".join(f"{name}: {meaning}" for name, meaning in verdicts.MEANINGS.items())
    document.text(
        "A setting stands in one of the first lists when it is that on some scene and makes no difference on "
        f"the others ({meanings}); a trap is nowhere faster or more accurate. A time differs when both "
        "quartiles of the pairs' ratios lie on one side of 1 and the median does by more than the base "
        "beside itself, and than any setting that was measured twice, under two names, beside itself "
        f"({noises}); an error when it does by a factor of {verdicts.ERROR_CHANGES}. Worth turning are those "
        "that buy accuracy on some scenes and have it free on the others, first those whose error falls most "
        "for the time."
    )
    document.text(_steadiness(results, scenes))
    rows = [
        (_words(results, setting), *(by_scene.get(scene, NOTHING) for scene in scenes))
        for setting, by_scene in found.items()
    ]
    document.table(("setting", *scenes), rows)


def _steadiness(results: Results, scenes: list[str]) -> str:
    """How long the base took at different times of a run: the base beside itself shows one moment."""
    words = []
    for scene in scenes:
        least, most = (fixed(ms, 2) for ms in results.base_range(scene))
        words.append(f"{scene} {least} to {most} ms, median {fixed(results.base_ms(scene), 2)}")
    return (
        f"In the course of the run the base took {'; '.join(words)}. A delay of as many milliseconds for "
        "both frames of a pair, as of a busy host, brings their ratio nearer to 1: a setting that was drawn "
        "at such a time looks cheaper beside the others than it is."
    )


def _verdicts(results: Results, scenes: list[str]) -> dict[tuple[str, str], dict[str, str]]:
    """Setting -> scene -> verdict, of what keeps the base's definition."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    noise = {scene: verdicts.noise(results, scene) for scene in scenes}
    for setting in results.settings():
        for scene in scenes:
            point = results.at(scene, *setting)
            if point is None or not point.same_picture or point.knob in ("base", ALONE):
                continue
            base = results.base(scene)
            if point.quality != base.quality:  # a preset may be the base itself
                found.setdefault(setting, {})[scene] = verdicts.verdict(point, base, noise[scene])
    return found


def _constants(results: Results, scenes: list[str]) -> dict[tuple[str, str], dict[str, str]]:
    """Setting -> scene -> verdict beside the exact picture, of the constants that were put into it. Beside
    the base, errors of its cut-off hide what most of them do."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for scene in scenes:
        exact, noise = results.at(scene, ALONE, "exact"), verdicts.noise(results, scene)
        if exact is None:
            continue
        for point in results.of(scene):
            if point.knob == ALONE and point is not exact and point.same_picture:
                verdict = verdicts.verdict(point, exact, noise, exact.ratio)
                found.setdefault((ALONE, point.value), {})[scene] = verdict
    return found


def _sorted_out(constants: dict[tuple[str, str], dict[str, str]]) -> str:
    """What the constants are, in words."""
    groups = {
        "traps": [s for s, v in constants.items() if _is_trap(v)],
        "free time": [s for s, v in constants.items() if _only(v, verdicts.FASTER)],
        "buying time on some scene": [s for s, v in constants.items() if verdicts.CHEAPER in v.values()],
        "without a difference": [s for s, v in constants.items() if set(v.values()) == {verdicts.NOTHING}],
    }
    values = {name: ", ".join(value for _, value in settings) for name, settings in groups.items()}
    return "; ".join(f"{name}: {words or 'none'}" for name, words in values.items())


def _is_trap(by_scene: dict[str, str]) -> bool:
    better = {verdicts.CHEAPER, verdicts.BOUGHT, verdicts.FREE, verdicts.FASTER}
    return verdicts.TRAP in by_scene.values() and not better & set(by_scene.values())


def _only(by_scene: dict[str, str], wanted: str) -> bool:
    return wanted in by_scene.values() and set(by_scene.values()) <= {wanted, verdicts.NOTHING}


def _words(results: Results, setting: tuple[str, str]) -> str:
    return next(p.words for p in results.points.values() if (p.knob, p.value) == setting)


def _bargains(results: Results, scenes: list[str], found: dict[tuple[str, str], dict[str, str]]) -> list[str]:
    """The best few settings that buy accuracy and lose it nowhere: what they cost and give on each scene."""
    ranked = []
    for setting, by_scene in found.items():
        if verdicts.BOUGHT not in by_scene.values() or not set(by_scene.values()) <= _BETTER:
            continue
        gain, cost, words = 0.0, 0.0, []
        for scene in by_scene:
            point, base = results.points[scene, *setting], results.base(scene)
            factor = base.maximum / max(point.maximum, 1e-9)
            gain, cost = gain + math.log(factor), cost + math.log(point.ratio)
            words.append(f"{scene} {percent(point.ratio)}, error / {factor:.2g}")
        worth = gain / cost if cost > 0 else math.inf
        ranked.append((worth, f"{_words(results, setting)} ({'; '.join(words)})"))
    return [words for _, words in sorted(ranked, reverse=True)[:5]]


def report_goals(document: Document, results: Results) -> None:
    """Beside gsplat's constants, in our own kernels: as fast at its error, how much better in its time; and
    what it costs to be invisibly wrong."""
    rows = []
    for scene in [scene for scene in results.scenes if not is_marker(scene)]:
        gsplat = results.at(scene, *GSPLAT)
        if gsplat is None:
            continue
        ours = [p for p in results.of(scene) if p.same_picture and p.quality != gsplat.quality]
        as_good = [p for p in ours if p.maximum <= gsplat.maximum]
        as_fast = [p for p in ours if p.ratio <= gsplat.ratio * _EQUAL_TIME]
        quickest = min(as_good, key=lambda p: p.ratio, default=None)
        best = min(as_fast, key=lambda p: p.maximum, default=None)
        rows.append(_equal_error(scene, gsplat, quickest))
        rows.append(_equal_time(scene, gsplat, best))
    document.table(("scene", "wanted", "found", "by", "reached"), rows)
    document.text(
        f"Times within {_EQUAL_TIME - 1:.0%} are equal. What is found is the best of all settings, so that "
        "between settings as good as each other the luckier time stands here."
    )
    plain = [scene for scene in results.scenes if not is_marker(scene)]
    choices = {
        "random scenes": [scene for scene in plain if scene != HARD],
        "random scenes and hard cases": plain,
    }
    sentences = []
    for words, scenes in choices.items():
        chosen = verdicts.cheapest_within(results, scenes, verdicts.INVISIBLE) if scenes else None
        if chosen is not None:
            facts = "; ".join(f"{p.scene} {percent(p.ratio)}, error {number(p.sure)}" for p in chosen)
            sentences.append(f"on {words}: {chosen[0].words} ({facts})")
    bound = f"1/512 ({verdicts.INVISIBLE:.2g})"
    document.text(
        f"The cheapest setting whose largest error is at most {bound}, apart from certified flips, "
        + (" and ".join(sentences) + "." if sentences else "is not among those measured.")
    )


def _equal_error(scene: str, gsplat: Measured, quickest: Measured | None) -> tuple[str, ...]:
    wanted = "at gsplat's error at least as fast"
    if quickest is None:
        return scene, wanted, "none has its error", NOTHING, "no"
    ratio = quickest.ratio / gsplat.ratio
    return scene, wanted, f"{ratio:.3f} of its time", quickest.words, _yes(ratio <= _EQUAL_TIME)


def _equal_time(scene: str, gsplat: Measured, best: Measured | None) -> tuple[str, ...]:
    wanted = (
        "in gsplat's time 10 times as accurate"
        if scene == HARD
        else "in gsplat's time: as accurate as can be"
    )
    if best is None:
        return scene, wanted, "none takes its time", NOTHING, "no"
    factor = gsplat.maximum / max(best.maximum, 1e-9)
    reached = _yes(factor >= _MORE_ACCURATE) if scene == HARD else NOTHING
    return scene, wanted, f"{factor:.3g} times", best.words, reached


def _yes(reached: bool) -> str:
    return "yes" if reached else "no"
