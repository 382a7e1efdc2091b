"""How a picture is fitted into a memory budget: all at once, or in chunks of splats and bands of rows."""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.errors import DeviceError

CHUNK = 1 << 20
"""most splats that are projected at once where a cloud is taken in chunks; a power of two, so that pieces of
every array start where any device lets a buffer start"""
_LEAST = 1 << 10

KEYS, WINDOWS, SORTED, PAIR = 4, 8, 16, {"ordered": 4, "tiled": 12}
"""bytes per splat of sort keys, of tile windows, and of keys and indices being sorted; bytes per pair"""


@dataclass(frozen=True)
class Plan:
    """What one picture may hold at once."""

    chunk: int
    """splats that are projected at once; 0: all, without packing those that are seen"""
    capacity: int
    """splats of one band that are kept, if in chunks"""


def plan_of(
    count: int, record_bytes: int, upload_bytes: int, fixed_bytes: int, lists: str, budget: int, largest: int
) -> Plan:
    """The plan for `count` splats.

    Args:
        record_bytes: of a splat's record.
        upload_bytes: per splat, where the cloud itself does not stay on the device; else 0.
        fixed_bytes: sample planes, outputs, and the cloud if it stays.
        budget: bytes that everything may take together. largest: bytes that one buffer may take.

    Raises:
        DeviceError: the budget does not even hold the picture.
    """
    direct = count * (record_bytes + KEYS + WINDOWS + (SORTED if lists == "ordered" else 0))
    pairs = budget // 8
    fits = not upload_bytes and fixed_bytes + direct + pairs <= budget
    if fits and count * record_bytes <= largest:
        return Plan(0, count)
    free = budget - fixed_bytes - pairs
    each = record_bytes + KEYS + WINDOWS
    chunk = CHUNK
    while chunk > _LEAST and (chunk * (each + upload_bytes) > free // 4 or chunk > 2 * count):
        chunk //= 2
    capacity = (free - chunk * (each + upload_bytes)) // (each + SORTED)
    capacity = min(capacity, largest // record_bytes, count)
    if capacity < min(_LEAST, count):
        raise DeviceError(
            f"a memory budget of {budget / 2**20:.0f} MiB is too small: the picture and the cloud alone take "
            f"{fixed_bytes / 2**20:.0f} MiB; raise memory_budget, or draw a smaller picture or fewer outputs"
        )
    return Plan(chunk, capacity)
