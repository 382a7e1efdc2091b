"""How many splats can be trained within an amount of memory."""

from __future__ import annotations

from dataclasses import replace

from fidsplat.train.dataset import Dataset
from fidsplat.train.settings import TrainSettings
from fidsplat.util.arguments import instance, whole_number
from fidsplat.util.errors import InputError

_COPIES = 7
"""of a splat's values at most: themselves, Adam's two means, as they are drawn, their gradients by those and
by themselves, and what stands beside them while splats are made"""
_WORK = 256
"""bytes of a splat: its record and its place in the lists of tiles"""
_FLOATS_OF_A_PIXEL = 60
"""of the loss: the pictures and their blurred products"""


def splats_within(settings: TrainSettings, budget: int, dataset: Dataset) -> TrainSettings:
    """The settings with as many splats at most as can be trained within a budget of bytes.

    Raises:
        InputError: the pictures alone take it.
    """
    instance("settings", settings, TrainSettings)
    instance("dataset", dataset, Dataset)
    budget = whole_number("budget", budget, 1, 2**63 - 1)
    pictures = sum(view.picture.nbytes for view in (*dataset.views, *dataset.held_out))
    pixels = max(view.camera.width * view.camera.height for view in dataset.views)
    fixed = pictures + 4 * _FLOATS_OF_A_PIXEL * pixels
    floats = 11 + 3 * (settings.sh_degree + 1) ** 2
    room = (budget - fixed) // (4 * floats * _COPIES + _WORK)
    if room < 1:
        raise InputError(
            f"the pictures of {dataset.name} alone take {fixed / 2**30:.2g} GiB of the {budget / 2**30:.2g} "
            "GiB that are allowed; allow more, or make them smaller"
        )
    return replace(settings, max_splats=min(settings.max_splats, room))
