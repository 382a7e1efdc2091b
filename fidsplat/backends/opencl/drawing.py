"""The stages of a picture on an in-order queue: project, lists, blend, expose, resolve.

Nothing passes through the host between the stages but the number of (splat, tile) pairs, which sizes one
buffer; and not even that where pictures of the kind were drawn before (recording.py). A picture with more
pairs than the device's budget is listed and blended in bands of tiles, with the same bits. One of several
poses is blended pose by pose, and resolved once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.lists import LISTS
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.view import SubFrame, View
from fidsplat.effects.catalogue import Output

_FIRST = np.zeros(1, np.uint32)
_FIRST.flags.writeable = False


@dataclass(frozen=True)
class Slots:
    """Where the views of a picture stand among the images of a batch."""

    numbers: np.ndarray
    """(views,) uint32, of each view"""
    images: dict[str, cl.Buffer]
    """of the whole batch, by the names of the kernels' arguments"""


_RAW = ("raw", 4, True)
"""the sample buffer of every picture: name, channels, whether it is light"""


def draw(
    start: Callable[[View], Picture], view: View, outputs: tuple[Output, ...], into: Slots | None = None
) -> Picture:
    """All stages; the output images are among what the picture has leased, unless they are given as `into`.
    `start` begins a picture."""
    picture = start(view)
    if into is None:
        into = Slots(_FIRST, {})
        pixels = (view.height // view.samples) * (view.width // view.samples)
        for output in outputs:
            picture.lease(f"{output.name}_out", 4 * pixels * output.channels)
    picture.held |= into.images
    picture.put("slots", into.numbers)
    if view.sub_frames:
        _expose(start, picture)
        _resolve(picture)
        return picture
    for _ in _blended(picture):
        _resolve(picture)
    return picture


def _buffers_of(picture: Picture) -> list[tuple[str, int, bool]]:
    """Of each sample buffer the name, its channels, and whether it is light."""
    return [_RAW, *((one.name, one.channels, averaged) for one, averaged in picture.source.samples)]


def _blended(picture: Picture) -> Iterator[None]:
    """All stages but the last: yields when all tiles are blended.

    Where lists were made before the host knew their length it may do so twice: what is launched then is under
    way while the host waits, and what comes last counts.
    """
    view, shape = picture.view, picture.shape
    picture.commands.clear()
    for name, channels, _ in _buffers_of(picture):
        picture.take(name, 4 * picture.held["channel_stride"] * channels)
    if any(one.name == "tile_ends" for one in picture.source.arguments["blend"]):
        ends = picture.lease("tile_ends", 4 * picture.tiles)
        if view.band is not None:  # beside which nothing is finished
            cl.enqueue_fill_buffer(
                picture.queue, ends, np.full(1, 0xFFFFFFFF, np.uint32), 0, 4 * picture.tiles
            )
    # not an attribute: in a cycle, all that this picture holds would wait for the garbage collector
    lists = LISTS["chunked" if picture.plan.chunk else shape.lists](picture)
    group = shape.blend_items
    for first, end in lists.bands():
        picture.launch("blend", "blend", (end - first) * group, group, band_first=first)
        if end == lists.end:
            if "backdrop" in picture.source.arguments:
                picture.launch_grid("resolve", "backdrop", view.width, view.height)
            yield
    picture.stats = lists.stats()


def _resolve(picture: Picture) -> None:
    """The last stage: pixels from samples, unless who drew them has done so."""
    view = picture.view
    if "resolve" not in picture.source.arguments:
        return
    size = view.width // view.samples, view.height // view.samples
    picture.launch_grid("resolve", "resolve", *size)


def _expose(start: Callable[[View], Picture], picture: Picture) -> None:
    """Blends the sub-frames of a picture of several poses one after another, and gathers their samples."""
    channel_stride, arguments = picture.rows * picture.stride, picture.source.arguments
    for name, channels, _ in _buffers_of(picture):
        # names of scratch buffers that no sub-frame's own have
        picture.held[name] = picture.pool.scratch(f"exposed {name}", 4 * channel_stride * channels)
    counts = {"splats": picture.resident.count, "visible": 0, "pairs": 0}
    # what is around is the same for all sub-frames
    around = {
        one.name: picture.put(one.name, picture.view.array(one.name))
        for one in arguments.get("backdrop", ())
        if one.source == "array"
    }
    for sub_frame in picture.view.sub_frames:
        own = start(sub_frame.view)
        own.held |= around
        for _ in _blended(own):
            pass
        picture.events += own.events
        _gather(picture, own, sub_frame)
        for name, value in own.stats().items():
            counts[name] = max(counts[name], value)
        picture.uploads += own.uploads
        picture.pool.give_back(own.leased)
    if any(one.name == "rays" for one in arguments["resolve"]):
        picture.put_rays()
    picture.stats = lambda: counts


def _gather(picture: Picture, own: Picture, sub_frame: SubFrame) -> None:
    """Adds a sub-frame's samples to the picture's."""
    whole = {
        "whole_stride": picture.stride,
        "whole_channel_stride": picture.rows * picture.stride,
        "top": sub_frame.top,
    }
    whole |= {"stride": own.stride, "channel_stride": own.rows * own.stride}
    size = sub_frame.view.width, sub_frame.view.height
    for name, channels, averaged in _buffers_of(picture):
        if not (averaged or sub_frame.middle):
            continue
        given = whole | {"channels": channels, "raw": own.held[name], "exposed": picture.held[name]}
        if averaged:
            given |= {"weight": sub_frame.weight, "first": sub_frame.first}
        picture.launch_grid("expose", "expose" if averaged else "expose_middle", *size, **given)
