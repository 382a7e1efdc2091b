"""An external depth image as an opaque surface among the fragments."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from fidsplat.backends.reference.error_bounds import Span
from fidsplat.backends.reference.fragment_order import OrderedFragments
from fidsplat.backends.reference.fragments import Fragments
from fidsplat.backends.view import View
from fidsplat.capture.environment import ExternalDepth


@dataclass
class Surface:
    """An external depth image at k samples."""

    z: np.ndarray
    """(k,) metres; infinite without a surface"""
    color: np.ndarray
    """(k, 3)"""
    label: np.ndarray
    """(k,)"""

    @property
    def exists(self) -> np.ndarray:
        """(k,) bool: whether a sample has a surface."""
        return np.isfinite(self.z)

    def occlude(self, f: Fragments, span: Span) -> Span:
        """Remove fragments at or behind the surface. If rounding may move a fragment behind the surface, its
        opacity interval starts at 0."""
        z = self.z[:, None]
        f.alpha = np.where(f.z < z, f.alpha, 0.0)
        return Span.of(
            np.where(span.z_high < z, span.low, 0.0),
            np.where(span.z_low < z, span.high, 0.0),
            span.z_low,
            span.z_high,
        )

    def append_to(self, ordered: OrderedFragments) -> OrderedFragments:
        """Append the surface behind all fragments."""
        k, m = ordered.alpha.shape
        exists = self.exists[:, None].astype(float)
        z = np.where(exists > 0, self.z[:, None], 0.0)
        span = ordered.span
        last = {
            "alpha": exists,
            "z": z,
            "colors": self.color[:, None],
            "normal": np.zeros((k, 1, 3)),
            "labels": self.label[:, None],
            "ids": np.full((k, 1), -1),
            "count": np.zeros((k, 1)),
            "count_bound": np.zeros((k, 1)),
            "moved": np.zeros((k, 1)),
            "label_may_flip": np.zeros((k, 1), bool),
            "id_may_flip": np.zeros((k, 1), bool),
        }
        joined = {}
        for field in fields(OrderedFragments):
            if field.name in last:
                own = getattr(ordered, field.name)
                shape = (k, m, *last[field.name].shape[2:])
                joined[field.name] = np.concatenate([np.broadcast_to(own, shape), last[field.name]], axis=1)
        # the surface is behind all fragments, whatever their order
        front_low = np.prod(1 - span.high, axis=1, keepdims=True)
        front_high = np.prod(1 - span.low, axis=1, keepdims=True)
        joined["span"] = replace(
            span,
            low=np.column_stack([span.low, exists]),
            high=np.column_stack([span.high, exists]),
            z_low=np.column_stack([span.z_low, z]),
            z_high=np.column_stack([span.z_high, z]),
            front_low=np.column_stack([span.front_low, front_low]),
            front_high=np.column_stack([span.front_high, front_high]),
        )
        return replace(ordered, **joined)


def surface_at(external: ExternalDepth, view: View, x: np.ndarray, y: np.ndarray) -> Surface:
    """An external depth image at samples (k,) with grid positions x, y."""
    row, column = (np.floor(at / view.samples).astype(int) for at in (y, x))
    color, label = external.rgb[row, column].astype(np.float64), np.asarray(external.label)[row, column]
    return Surface(external.depth[row, column].astype(np.float64), color, label)
