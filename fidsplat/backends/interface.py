"""What every backend offers, and what only some do: typed protocols, by which others tell what a backend can.

Nobody outside a backend asks for its name: a capability is asked for with `isinstance(backend, Adopts)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.effects.select import Traits
from fidsplat.splats.cloud import SplatCloud


@dataclass(frozen=True)
class DeviceInfo:
    """One device that a backend sees."""

    name: str
    """What to pass as `device=` to get this one."""
    title: str
    platform: str
    version: str
    kind: str
    """cpu, gpu or other"""
    compute_units: int
    memory_bytes: int
    largest_allocation_bytes: int
    float64: bool
    usable: bool
    reason: str
    """Why it cannot be used; empty if it can. For a usable device, a remark (may be empty)."""
    always_float64: bool = False
    """whether all is computed in float64: slow, and what other devices are compared with"""


@dataclass(frozen=True)
class Rates:
    """What a device can do at best, measured: per second."""

    copy_bytes: float
    """bytes read and bytes written by a copy, together"""
    fma: float
    """float32 multiply-adds"""
    exp: float
    """float32 exponentials, as the blend stage calls them"""
    division: float
    """float32 divisions, as the blend stage writes them"""


class ResidentData(Traits, Protocol):
    """A cloud on a device."""

    @property
    def count(self) -> int:
        """Splats."""
        ...

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 metres: the world's position of the means' zero."""
        ...

    @property
    def memory_bytes(self) -> int:
        """Device memory that it takes; 0 where the device reads the host's own arrays."""
        ...


@runtime_checkable
class HasColorRange(Protocol):
    """A cloud whose colours are known, as the output `error` requires."""

    @property
    def count(self) -> int:
        """Splats."""
        ...

    def color_range(self) -> tuple[float, float]:
        """Lower and upper bound of every channel of every splat, from any direction."""
        ...


class Images(Protocol):
    """Finished output images of one picture, on the device until asked for."""

    def read(self, name: str) -> np.ndarray:
        """The image as a NumPy array of its own, in the type of `OUTPUTS[name]`."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, in the order in which they ran."""
        ...

    @property
    def stats(self) -> Mapping[str, int]:
        """splats, visible, pairs."""
        ...


@runtime_checkable
class Waits(Protocol):
    """Images that may still be on their way."""

    def wait(self) -> None:
        """Until the device has drawn them."""
        ...


class BatchImages(Protocol):
    """Finished output images of many views."""

    @property
    def views(self) -> int:
        """How many, those that were masked out among them."""
        ...

    def read(self, name: str) -> np.ndarray:
        """The images as a NumPy array of its own, (views, h, w) or (views, h, w, channels), in the type of
        `OUTPUTS[name]`; where a view was masked out 0, or -1 in `label` and `splat_id`."""
        ...

    def read_one(self, name: str, number: int) -> np.ndarray:
        """The image of one view, as a NumPy array of its own."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Milliseconds on the device by stage, of all views together."""
        ...

    @property
    def stats(self) -> Mapping[str, int]:
        """splats in the cloud; visible and pairs of all views together."""
        ...


@runtime_checkable
class GivesArrays(Protocol):
    """Images that others on the device can use where they were drawn."""

    def device_array(self, name: str) -> Any:
        """The image as an array of the device, (h, w) or (h, w, channels), of a batch with the views before
        these; no copy."""
        ...


@runtime_checkable
class GivesFloat64(Protocol):
    """Images that were computed in float64 and still are."""

    def read_float64(self, name: str) -> np.ndarray:
        """The image as a NumPy array in float64."""
        ...


@runtime_checkable
class GivesUint8(Protocol):
    """Images whose 8-bit values the device makes, so that a quarter of the bytes is copied."""

    def read_uint8(self, name: str) -> np.ndarray:
        """An image of floats in [0, 1] as `to_uint8` (fidsplat/images/files.py) makes it of what `read`
        gives, bit for bit: a NumPy array of its own, (h, w) or (h, w, channels) uint8."""
        ...


@runtime_checkable
class ReadsRows(Protocol):
    """Images of which some rows can be read alone."""

    def empty(self, name: str) -> np.ndarray:
        """An array for the whole image."""
        ...

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray) -> None:
        """Copies rows of pixels [first, end) of an image, as `read` gives them, to those of such an array."""
        ...


@runtime_checkable
class DrawsEvery(Protocol):
    """A pipeline that draws pixels one by one: it can leave some out, and say how far it is."""

    def render_every(
        self, cloud: Any, view: Any, step: int, tell: Callable[[float], object] | None = None
    ) -> Images:
        """Every step-th pixel in both directions, beginning with the first: images of (ceil(h / step),
        ceil(w / step)) with the bits that `render` gives those pixels. tell: called with the share that is
        done, 0 to 1."""
        ...


@runtime_checkable
class DrawsBatches(Protocol):
    """A pipeline that draws many views together."""

    def render_batch(self, resident: Any, batch: ViewBatch) -> BatchImages:
        """Draw many views of an uploaded cloud, each with the bits of itself alone."""
        ...


class Pipeline(Protocol):
    """The stages compiled for one FeatureSet."""

    def render(self, resident: Any, view: View) -> Images:
        """Draw one picture of an uploaded cloud."""
        ...

    def trace(self, resident: Any, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages, for tests."""
        ...


class Backend(Protocol):
    """An open device."""

    info: DeviceInfo

    def limit_memory(self, budget: int) -> None:
        """Let a picture and its cloud take at most `budget` bytes of the device."""
        ...

    def upload(self, cloud: SplatCloud) -> ResidentData:
        """The cloud on the device."""
        ...

    def unsupported(self, features: FeatureSet) -> str:
        """What of these features the device cannot draw, as the message of the error that drawing them
        raises; empty if it can draw all."""
        ...

    def pipeline(self, features: FeatureSet) -> Pipeline:
        """The pipeline for these features, compiled on first use.

        Raises:
            DeviceError: what is `unsupported`; or the compiler refuses.
        """
        ...


@runtime_checkable
class Adopts(Protocol):
    """A backend that draws splats from arrays that are on the device already."""

    def adopt(self, arrays: Mapping[str, Any], origin: np.ndarray) -> ResidentData:
        """Arrays (`means`, `quats`, ...) used where they lie. Raises InputError for one that cannot be."""
        ...


@runtime_checkable
class Measurable(Protocol):
    """A backend that can be held against its hardware. It also has kernels for the effect `overdraw`."""

    @property
    def memory_bytes(self) -> int:
        """Device memory that scratch buffers hold; clouds and finished images are not among them."""
        ...

    def release_scratch(self) -> None:
        """Let go of them, so that the next picture shows what it needs."""
        ...

    def rates(self) -> Rates:
        """What the device can do at best; measured again at each call."""
        ...
