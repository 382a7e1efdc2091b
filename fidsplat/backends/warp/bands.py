"""Pictures with more pairs of splats and tiles than there is room for: they are drawn in bands of tiles, with
the same bits."""

from __future__ import annotations

from fidsplat.backends.view import View
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.structs import memory_bytes
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.errors import DeviceError

# bytes: of one splat's bounds; of its window, keys, counts, drawn, places, sums; of one that is drawn, in
# sort and lists; of a pair with the scratch of its sort
_BOUNDS, _PROJECTED, _VISIBLE, _PAIR = 44, 36, 40, 24


def image_bytes(program: Program, view: View, grid: tuple[int, int]) -> int:
    """What sample buffers, of a padded grid of (rows, columns), and output images take."""
    sample = sum(map(load().types.type_size_in_bytes, program.sample_fields.values()))
    pixel = sum(4 * output.channels for output in program.images)
    pixels = view.width * view.height // view.samples**2
    return grid[0] * grid[1] * sample + pixels * pixel


def room(
    program: Program, workspace: Workspace, resident: Resident, view: View, visible: int, images: int
) -> int:
    """How many pairs may be listed at once within the budgets; images: bytes of all of them, `image_bytes`.

    Raises:
        DeviceError: what else the picture needs is more than the memory budget.
    """
    # as the stages take them; the sorts have as much again
    each = 16 * program.layout.lines + _BOUNDS + _PROJECTED
    fixed = resident.memory_bytes + each * resident.count + _VISIBLE * visible + images
    fixed += memory_bytes(view, workspace)
    pairs = (workspace.memory_budget - fixed) // _PAIR
    if pairs < 1:
        raise DeviceError(
            f"a memory budget of {workspace.memory_budget / 2**20:.0f} MiB is too small for {resident.count} "
            f"splats in this picture, which take {fixed / 2**20:.0f} MiB before their lists; raise "
            "memory_budget, or use an OpenCL device, which draws a cloud in chunks"
        )
    return min(workspace.pair_budget, pairs)
