"""From a bound on the error, on the time, or on both, to the quality that keeps it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any

from fidsplat.budget import store, table
from fidsplat.budget.calibrate import Calibration
from fidsplat.budget.search import Search
from fidsplat.budget.table import Setting
from fidsplat.cameras import Camera
from fidsplat.errors import DeviceError, InputError
from fidsplat.provenance import code_hash
from fidsplat.quality import Quality
from fidsplat.render import Renderer, default_device
from fidsplat.scenes import Scene
from fidsplat.splats import SplatCloud


@dataclass(frozen=True)
class Choice:
    """A quality, and why it was chosen."""

    quality: Quality
    error: float
    """largest absolute error of rgb: measured on the scene, or else promised by the table"""
    ms: float | None
    """median time of a frame, milliseconds; None where nothing was timed"""
    ms_late: float | None
    """90th percentile"""
    source: str
    """`table`, `measured`, or `kept`: measured before, and read from the user's cache folder"""
    device: str
    """name of the device"""
    knobs: dict[str, Any]
    """where it differs from the settings that a budget starts from (`table.FREE`)"""

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the quality itself, and what it takes to make it again."""
        keys = ("error", "ms", "ms_late", "source", "device", "knobs")
        return {key: getattr(self, key) for key in keys}

    @property
    def summary(self) -> str:
        """One line for people."""
        knobs = ", ".join(
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in ({"alpha_cutoff": self.quality.alpha_cutoff} | self.knobs).items()
        )
        how = "promised error" if self.source == "table" else "measured error"
        took = "" if self.ms is None else f", {self.ms:.3g} ms a frame"
        return f"{knobs}: {how} {self.error:.2g}{took} on {self.device}"


def choose(
    error: float | None = None,
    ms: float | None = None,
    camera: Camera | None = None,
    cloud: Scene | SplatCloud | None = None,
    device: str | Renderer | None = None,
    base: Quality | str | None = None,
    tell: Callable[[str], None] = lambda text: None,
    **around: Any,
) -> Choice:
    """As `Quality.within`, with what is known about the quality beside it. `tell`: called with what is being
    done.

    Raises:
        InputError: as `Quality.within`. DeviceError: the device cannot be used or fails.
    """
    check_bounds(error, ms)
    own = cloud if isinstance(cloud, Scene) else Scene(())
    definition = Quality.of(own.quality if base is None else base)
    camera = camera or own.camera
    for name, given in (("cloud", cloud), ("camera", camera)):
        if given is None and (ms is not None or cloud is not None or camera is not None):
            raise InputError(f"this budget needs a {name} to measure with: give camera=... and cloud=...")
    if cloud is not None and not isinstance(cloud, (Scene, SplatCloud)):
        raise InputError(f"cloud is a {type(cloud).__name__}; give a SplatCloud or a Scene")
    renderer = device if isinstance(device, Renderer) else Renderer(device or default_device())
    settings = table.load(renderer.device.kind)
    if cloud is None or camera is None:
        assert error is not None
        return _from_table(error, settings, definition, renderer)
    for name in ("background", "motion", "shutter", "fog"):
        if around.get(name) is None:
            around[name] = getattr(own, name)
    splats = cloud.cloud() if isinstance(cloud, Scene) else cloud
    info = renderer.device
    drawn_by = (info.name, info.title, info.platform, info.version, code_hash())
    key = store.digest(drawn_by, (error, ms), definition, camera, splats, around)
    kept = _kept(key, definition, info.name)
    if kept is not None:
        return kept
    search = Search(Calibration(renderer, splats, camera, definition, around, tell), settings)
    choice = _measured(search, error, ms)
    numbers = {"error": choice.error, "ms": choice.ms, "ms_late": choice.ms_late}
    store.save(key, {"knobs": choice.knobs, **numbers})
    return choice


def check_bounds(error: float | None, ms: float | None) -> None:
    """Raises InputError for bounds that are no numbers. Only measuring shows which of the others cannot be
    kept."""
    if error is None and ms is None:
        raise InputError("a budget of nothing: give error=1e-3, or ms=20 with camera=... and cloud=...")
    for name, value, example in (("error", error, "1e-3"), ("ms", ms, "20")):
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        if value is not None and not number:
            raise InputError(f"{name} is {value!r}; it must be a finite number, e.g. {name}={example}")


def _from_table(error: float, settings: tuple[Setting, ...], base: Quality, renderer: Renderer) -> Choice:
    for setting in settings:
        drawn = _drawn(setting, base, renderer) if setting.promised <= error else None
        if drawn is not None:
            name = renderer.device.name
            return Choice(drawn.of(base), drawn.promised, None, None, "table", name, drawn.knobs)
    finest = sorted(settings, key=lambda setting: setting.promised)
    best = next(setting.promised for setting in finest if _drawn(setting, base, renderer))
    raise InputError(
        f"no setting promises an error of {error:g} for any scene on {renderer.device.name}: the best is "
        f"{best:.2g}; allow that, or give camera=... and cloud=... to measure yours"
    )


def _drawn(setting: Setting, base: Quality, renderer: Renderer) -> Setting | None:
    """The setting, or what keeps its promise without the knobs that the device lacks, or None."""
    if setting == setting.everywhere:
        return setting
    pixel = Camera.pinhole(1, 1, 1.0, 1.0, 0.5, 0.5)
    try:
        renderer.render(SplatCloud.empty(), pixel, quality=setting.of(base))
    except (InputError, DeviceError):
        return None if "blend_precision" in setting.knobs else setting.everywhere
    return setting


def _kept(key: str | None, base: Quality, device: str) -> Choice | None:
    """The answer of before, if there is one that can still be understood."""
    kept = store.load(key)
    try:
        if kept is None:
            return None
        setting = Setting(kept["knobs"], 0, 0, 0, 0)
        error, ms, late = (float(kept[name]) for name in ("error", "ms", "ms_late"))
        return Choice(setting.of(base), error, ms, late, "kept", device, setting.knobs)
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def _measured(search: Search, error: float | None, ms: float | None) -> Choice:
    if error is None:
        assert ms is not None
        found = search.most_accurate_in(ms)
    else:
        found = search.cheapest_within(error)
        if ms is not None and found.times.late > ms:
            raise InputError(
                f"an error of {error:g} takes {found.times.late:.3g} ms a frame on {search.device}, not "
                f"{ms:g}; {_best_in(search, ms)}"
            )
    times, setting = found.times, found.setting
    return Choice(
        found.quality, found.error, times.median, times.late, "measured", search.device, setting.knobs
    )


def _best_in(search: Search, ms: float) -> str:
    try:
        return f"the least error in that time is {search.most_accurate_in(ms).error:.2g}"
    except InputError as error:
        return str(error)
