"""Sensor steps, one file each, which declares a `Step`. They change rgb pixel by pixel after resolving. Files
are found by their names.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Step:
    """Sensor step: its inputs, and its function of one channel of a pixel."""

    uniforms: tuple[str, ...] = ()
    """groups of uniforms of the view (`View.uniforms_of`) that fill `numbers`, in this order"""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """number in `s`: type"""
    arrays: Mapping[str, Any] = field(default_factory=dict)
    """array of the view (`View.array`) in `s`: type of an element"""
    apply: Any
    """(v, x, y, channel, s): returns the channel's value after the step; s: a struct with the numbers and
    arrays of all steps"""


def known() -> frozenset[str]:
    """Names of all files."""
    return frozenset(module.name for module in pkgutil.iter_modules(__path__))


def declared(name: str) -> Step:
    """Declaration in the file of this name."""
    return import_module(f".{name}", __name__).STEP
