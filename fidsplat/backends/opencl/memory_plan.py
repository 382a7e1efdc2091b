"""How a picture is fitted into a memory budget: all at once, or in chunks of splats and bands of rows."""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.util.errors import DeviceError, bytes_words

CHUNK = 1 << 20
"""most splats that are projected at once where a cloud is taken in chunks; a power of two, so that pieces of
every array start where any device lets a buffer start"""
_LARGE = 1 << 23
"""as many, where that takes a small part of the memory: the host has less to do"""
_LEAST = 1 << 10

KEYS, WINDOWS, SORTED, PAIR = 4, 8, 16, {"ordered": 4, "tiled": 12, "gathered": 12}
"""bytes per splat of sort keys, of tile windows, and of keys and indices being sorted; bytes per pair"""
BIG = 1 << 12
"""big splats for which there is room at first"""
SMALL = 1 << 14
"""bytes for all that is small: uniforms, counts, groups that move"""


@dataclass(frozen=True)
class MemoryPlan:
    """What one picture may hold at once."""

    chunk: int
    """splats that are projected at once; 0: all, without packing those that are seen"""
    capacity: int
    """splats of one band that are kept, if in chunks"""
    held: int
    """bytes that all of it takes at most, the cloud included; more only if more than `BIG` splats are big"""


def table_bytes(lists: str, tiles: int, chunks: int, radix_bits: int) -> int:
    """What listing takes beside splats and pairs: tables, places and tallies."""
    if lists != "ordered":
        return 4 * 3 * tiles
    bins = 1 << radix_bits
    return 4 * ((tiles + bins) * (chunks + 2) + 3 * chunks)


def plan_of(
    count: int, record_bytes: int, upload_bytes: int, fixed_bytes: int, lists: str, budget: int, largest: int
) -> MemoryPlan:
    """The memory plan for `count` splats.

    Args:
        record_bytes: of a splat's record.
        upload_bytes: per splat, where the cloud itself does not stay on the device; else 0.
        fixed_bytes: sample buffers, outputs, tables, and the cloud if it stays.
        budget: bytes that everything may take together. largest: bytes that one buffer may take.

    Raises:
        DeviceError: the budget does not even hold the picture.
    """
    direct = count * (record_bytes + KEYS + WINDOWS + (SORTED if lists == "ordered" else 0))
    pairs = budget // 8
    fits = not upload_bytes and fixed_bytes + direct + pairs <= budget
    if fits and count * record_bytes <= largest:
        return MemoryPlan(0, count, fixed_bytes + direct + pairs)
    free = budget - fixed_bytes - pairs
    each = record_bytes + KEYS + WINDOWS
    chunk = CHUNK
    while chunk < _LARGE and chunk * (each + upload_bytes) < free // 64:
        chunk *= 2
    while chunk > _LEAST and (chunk * (each + upload_bytes) > free // 4 or chunk > 2 * count):
        chunk //= 2
    capacity = (free - chunk * (each + upload_bytes)) // (each + SORTED)
    capacity = min(capacity, largest // record_bytes, count)
    if capacity < min(_LEAST, count):
        raise DeviceError(
            f"a memory budget of {bytes_words(budget)} is too small: the picture and the cloud alone take "
            f"{bytes_words(fixed_bytes)}; raise memory_budget, or draw a smaller picture or fewer outputs"
        )
    held = fixed_bytes + pairs + chunk * (each + upload_bytes) + capacity * (each + SORTED)
    return MemoryPlan(chunk, capacity, held)
