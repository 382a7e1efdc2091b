"""What the device counts of a picture, read by the host: big splats, pairs, visible splats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.picture import Picture

# words of the buffer `counts`, as in tile_lists.cl: big splats, pairs (two words), visible splats
COUNTS = 4


def pairs_of(picture: Picture) -> int | None:
    """How many pairs a picture had; None where it was `trusted` to have fewer, so that nothing was drawn.
    Waits until the device has counted, not until it has drawn."""
    if picture.counted is None:
        return picture.pairs
    big, pairs = fullness_of(counts_after(picture.counted, picture))
    return pairs if big <= picture.held["big_capacity"] and pairs <= picture.pairs else None


def counts_after(counted: cl.Event, picture: Picture) -> np.ndarray:
    """The words of `counts` as the launch `counted` leaves them, while later stages go on."""
    picture.queue.flush()
    return read_counts(picture.workspace.side_queue, picture.held["counts"], [counted])


def read_counts(
    queue: cl.CommandQueue, counts: cl.Buffer, after: Sequence[cl.Event] | None = None
) -> np.ndarray:
    """The words of the buffer `counts` of a picture, once it is drawn or what is given is done."""
    words = np.empty(COUNTS, np.uint32)
    cl.enqueue_copy(queue, words, counts, wait_for=after)
    return words


def fullness_of(words: np.ndarray) -> tuple[int, int]:
    """Numbers of big splats and of pairs of a picture's `counts`."""
    return int(words[0]), int(words[1]) | int(words[2]) << 32


def stats_of(splats: int, words: np.ndarray) -> dict[str, int]:
    """What a frame tells of a picture's `counts`."""
    return {"splats": splats, "visible": int(words[3]), "pairs": fullness_of(words)[1]}
