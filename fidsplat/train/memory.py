"""Number of splats that can be trained within a memory budget."""

from __future__ import annotations

from dataclasses import replace

from fidsplat.train.dataset import Dataset
from fidsplat.train.settings import TrainSettings
from fidsplat.util.arguments import instance, whole_number
from fidsplat.util.errors import InputError

_COPIES = 7
"""maximum number of copies of each splat's values: raw, Adam's two moments, activated, the gradients of raw
and activated values, and one copy during densification"""
_WORK = 256
"""bytes per splat: its record and its entries in tile lists"""
_FLOATS_PER_PIXEL = 60
"""float32 values per pixel in the loss: images and their blurred products"""


def splats_within(settings: TrainSettings, budget: int, dataset: Dataset) -> TrainSettings:
    """The settings with `max_splats` lowered to fit a budget of bytes.

    Raises:
        InputError: the images alone exceed the budget.
    """
    instance("settings", settings, TrainSettings)
    instance("dataset", dataset, Dataset)
    budget = whole_number("budget", budget, 1, 2**63 - 1)
    images = sum(view.image.nbytes for view in (*dataset.views, *dataset.held_out))
    pixels = max(view.camera.width * view.camera.height for view in dataset.views)
    fixed = images + 4 * _FLOATS_PER_PIXEL * pixels
    floats = 9 + settings.axes + 3 * (settings.sh_degree + 1) ** 2
    capacity = (budget - fixed) // (4 * floats * _COPIES + _WORK)
    if capacity < 1:
        raise InputError(
            f"budget must be more than the {fixed / 2**30:.2g} GiB of the images of {dataset.name}, got "
            f"{budget / 2**30:.2g} GiB; give more, or make the images smaller"
        )
    return replace(settings, max_splats=min(settings.max_splats, capacity))
