"""Certification of a chosen quality by the output `error`, an upper bound on the error of each pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fidsplat.accuracy.candidates import DEFAULTS, Choice
from fidsplat.accuracy.error import supports_float64
from fidsplat.accuracy.search import SceneMeasurement
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import Sensor
from fidsplat.render.certified_error import cutoff_of, ideal_quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.util.errors import InputError

REFINEMENT = 1 / 16
"""factor that lowers cut-off and stop until the error is certified"""


def certify(
    choice: Choice,
    error: float,
    ms: float | None,
    scene: Scene,
    capture: Capture,
    renderer: Renderer,
    report: Callable[[str], None] = lambda message: None,
) -> Choice:
    """Lower the cut-off of a chosen quality until the output `error` of a frame is at most `error` at every
    pixel.

    If the output is not available, returns the given choice with the reason as its remark.

    Raises:
        InputError: the finest quality is not certified, or takes longer than `ms`; the message names the
            smallest possible error, or time.
    """
    plain = replace(capture, outputs=("error",), sensor=Sensor())
    resident, quality = renderer.upload(scene), choice.quality
    cutoff, float64 = cutoff_of(len(resident)), supports_float64(renderer, plain)
    while True:
        report(f"certifying a cut-off of {quality.alpha_cutoff:.2g} in {quality.blend_precision}")
        try:
            frame = renderer.render(resident, plain.with_(quality=quality))
        except InputError as refused:
            return replace(choice, remark=f"not certified: {refused}")
        certified = float(frame["error"].max(initial=0.0))
        if certified <= error:
            break
        if quality.blend_precision == "float16":
            quality = quality.with_(blend_precision="float32")
            continue
        if quality.alpha_cutoff > cutoff:
            finer = max(REFINEMENT * quality.alpha_cutoff, cutoff)
            stop = REFINEMENT * quality.transmittance_stop if finer > cutoff else 0.0
            quality = ideal_quality(quality, finer).with_(transmittance_stop=stop)
            continue
        if float64 and quality.blend_precision == "float32":
            quality = quality.with_(blend_precision="float64", arithmetic="precise")
            continue
        raise InputError(
            f"error must be at least {certified:.2g} to be certified for this scene on {choice.device}, got "
            f"{error:g}; allow a larger error"
        )
    if quality == choice.quality:
        return replace(choice, certified=certified)
    measurement = SceneMeasurement(renderer, scene, plain.with_(outputs=("rgb",)), report)
    (times,) = measurement.times([quality])
    if ms is not None and times.p90 > ms:
        raise InputError(
            f"ms must be at least {times.p90:.3g} on {choice.device} for a certified error of {error:g}, "
            f"got {ms:g}; allow more time or a larger error"
        )
    settings = {
        name: getattr(quality, name) for name, value in DEFAULTS.items() if getattr(quality, name) != value
    }
    # the error of the refined quality was not measured; its certified bound replaces it
    return Choice(
        *(quality, certified, times.median, times.p90, "measured", choice.device, settings),
        certified=certified,
    )
