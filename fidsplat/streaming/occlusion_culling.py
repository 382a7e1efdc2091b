"""Occlusion culling of chunks: occluded chunks are neither read nor rendered.

The frame is bit-identical to that of all chunks (fidsplat/backends/termination_depth.py). A view is first
rendered from an initial guess: the nodes that the previous view's termination depths do not occlude, or the
nearest nodes. The other nodes are then tested against the termination depths of this frame. If all are
occluded, the frame is complete. If a few are visible, the tiles to which they can contribute are rendered
again and copied into the frame. If many are visible, they are added and all tiles are rendered again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.store.chunked_splats import NodeMasks
from fidsplat.streaming.bands import Band
from fidsplat.streaming.occlusion_test import node_sort_keys

MIN_SPLATS = 1_000_000
"""views of fewer splats are rendered without occlusion culling"""
_INITIAL_SPLATS = 1_500_000
"""number of splats of the first guess, and minimum number added per pass"""
_MAX_GROWTH = 2.0
"""maximum factor by which a guess grows per pass, as the added nodes may occlude the rest"""
_MAX_VISIBLE = 0.7
"""fraction of visible splats above which all splats of a view are rendered"""
_PROBE_DIVISOR, _PROBE_SPLATS = 4, 4_000_000
"""minimum size of a pass after which culling may be abandoned: 1 / 4 of the view's splats, and 4 million"""
_PAUSE = 16
"""number of views without occlusion culling after a view with little occlusion"""
_SAMPLES_PER_TILE, _MOTION_SLACK = 4, 4.0
"""reprojection of termination depths: number of sampled directions per tile, across and down; and multiple
of the camera's motion that is added to the depths"""
_PATCH_RATIO = 2
"""missing chunks are rendered alone if the frame has at least this many times their splats"""
_MAX_PASSES = 12
"""maximum number of passes, after which a view is rendered from all visible chunks"""


class OcclusionCulling:
    """Occlusion culling of successive views, by the termination depths of the previous view."""

    def __init__(self) -> None:
        self._last: tuple[View, TerminationDepths] | None = None
        self._pause = 0
        """number of views to render without occlusion culling"""

    def is_worthwhile(self, full: Band, views_later: int = 0) -> bool:
        """Whether occlusion culling may save time. views_later: number of views that are rendered before."""
        return full.count >= MIN_SPLATS and self._pause <= views_later

    def skip_view(self) -> None:
        """Count a view that was rendered without occlusion culling."""
        self._pause = max(self._pause - 1, 0)

    def initial_guess(self, full: Band) -> Band:
        """The band with the nodes from which its view is rendered first."""
        last = self._last
        termination = None if last is None else _reprojected(*last, full.view)
        if termination is None:
            return full.with_nodes(_nearest(full, full.nodes, _INITIAL_SPLATS))
        return full.without_occluded(termination)

    def render(
        self,
        full: Band,
        fits: Callable[[Band, int], bool],
        render_band: Callable[[Band, int], tuple[Images, TerminationDepths]],
        copy_tiles: Callable[[Images, Images, np.ndarray], None],
    ) -> tuple[list[Band], Images] | None:
        """Render a view without occluded chunks, and return the rendered bands and the images.

        Returns None if the view must be rendered from all visible chunks: few chunks are occluded, or the
        others do not fit.

        Args:
            fits, render_band: functions of a band and the index of its first splat among all bands.
            copy_tiles: copies the tiles of a mask (rows, columns) from the second images to the first.
        """
        bands, frame, tiles = [self.initial_guess(full)], None, np.array(True)
        for _ in range(_MAX_PASSES):
            band, first_id = bands[-1], sum(earlier.count for earlier in bands[:-1])
            if not fits(band, first_id):
                break
            images, termination = render_band(band, first_id)
            if frame is not None:
                copy_tiles(frame[0], images, tiles)
                images, termination = frame[0], frame[1].replaced(tiles, termination)
            self._last = full.view, termination
            termination_of_tiles = termination.within(tiles)
            missing = _minus(band.missing, band.occluded(termination_of_tiles))
            patchable = full.count_of(missing) <= bands[0].count // _PATCH_RATIO
            subchunks = band.missing_subchunks(termination_of_tiles, missing) if patchable else []
            if patchable and not subchunks:
                self._pause = _PAUSE if bands[0].count > _MAX_VISIBLE * full.count else 0
                return bands, images
            # a patch of tiles must not share a pixel with other tiles
            if patchable and not any(side % full.view.samples for side in termination.tile):
                tiles = band.contributing_tiles(subchunks, termination_of_tiles)
                patch = full.with_rows(*_rows(tiles, full, termination)).without_occluded(
                    termination.within(tiles)
                )
                if patch.count <= bands[0].count // _PATCH_RATIO:
                    bands, frame = [*bands, patch], (images, termination)
                    continue
            images = frame = None  # releases its buffers for the next pass
            tiles, occluded = np.array(True), full.occluded(termination)
            missing = _minus(bands[0].missing, occluded)
            visible = bands[0].count + full.count_of(missing)
            nearest_missing = _nearest(full, missing, max(_INITIAL_SPLATS, int(_MAX_GROWTH * bands[0].count)))
            pairs = zip(_minus(bands[0].nodes, occluded), nearest_missing, strict=True)
            bands = [full.with_nodes(tuple(a | b for a, b in pairs)).without_occluded_subchunks(termination)]
            probe = max(full.count // _PROBE_DIVISOR, _PROBE_SPLATS)
            if visible > _MAX_VISIBLE * full.count and bands[0].count > probe:
                break
        self._pause = _PAUSE
        return None


def _rows(tiles: np.ndarray, full: Band, termination: TerminationDepths) -> tuple[int, int]:
    """Rows of pixels [first, end) of a view that contain the selected tiles."""
    rows, height = np.flatnonzero(tiles.any(axis=1)), termination.tile[0] // full.view.samples
    return max(int(rows[0]) * height, full.rows[0]), min((int(rows[-1]) + 1) * height, full.rows[1])


def _minus(nodes: NodeMasks, others: NodeMasks) -> NodeMasks:
    return tuple(mask & ~other for mask, other in zip(nodes, others, strict=True))


def _nearest(full: Band, nodes: NodeMasks, max_splats: int) -> NodeMasks:
    """The nearest of the given nodes, with about `max_splats` splats in total; at least one node."""
    keys = node_sort_keys(full.scene, full.view, full.features)
    depths = [depth[mask] for depth, mask in zip(keys, nodes, strict=True)]
    counts = [count[mask] for count, mask in zip(full.scene.node_counts, nodes, strict=True)]
    order = np.argsort(np.concatenate(depths), kind="stable")
    is_near = np.zeros(len(order), bool)
    splats_before = np.cumsum(np.concatenate(counts)[order], dtype=np.int64) - np.concatenate(counts)[order]
    is_near[order[splats_before < max_splats]] = True
    masks, first = [], 0
    for mask in nodes:
        selected, count = mask.copy(), int(np.count_nonzero(mask))
        selected[mask] = is_near[first : first + count]
        masks.append(selected)
        first += count
    return tuple(masks)


def _reprojected(last: View, termination: TerminationDepths, view: View) -> TerminationDepths | None:
    """Estimated termination depths of a view: those of the previous view in the same directions, plus a
    multiple of the camera's motion. None if the views overlap by less than half."""
    if (last.width, last.height, last.parallel) != (view.width, view.height, view.parallel):
        return None
    rows, columns = termination.depths.shape
    depths = termination.depths
    if view.raster is None and not view.parallel:
        depths, overlaps = np.full_like(depths, -np.inf), []
        within = (np.arange(_SAMPLES_PER_TILE) + 0.5) / _SAMPLES_PER_TILE
        for row_offset, column_offset in product(within, within):
            y, x = np.mgrid[0:rows, 0:columns]
            y, x = (y + row_offset) * termination.tile[0], (x + column_offset) * termination.tile[1]
            ray = (x - view.center_x) / view.focal_x, (y - view.center_y) / view.focal_y, np.ones(x.shape)
            last_ray = np.stack(ray, -1) @ view.rotation @ last.rotation.T
            in_front = last_ray[..., 2] > 0
            z = np.where(in_front, last_ray[..., 2], 1.0)
            column = (last_ray[..., 0] / z * last.focal_x + last.center_x) // termination.tile[1]
            row = (last_ray[..., 1] / z * last.focal_y + last.center_y) // termination.tile[0]
            overlaps.append(in_front & (column >= 0) & (column < columns) & (row >= 0) & (row < rows))
            row, column = np.clip(row, 0, rows - 1).astype(int), np.clip(column, 0, columns - 1).astype(int)
            depths = np.maximum(depths, np.where(in_front, termination.depths[row, column], np.inf))
        if np.mean(overlaps) < 0.5:
            return None
    distance = float(np.linalg.norm(view.rotation.T @ view.translation - last.rotation.T @ last.translation))
    return replace(termination, depths=(depths + np.float32(_MOTION_SLACK * distance)).astype(np.float32))
