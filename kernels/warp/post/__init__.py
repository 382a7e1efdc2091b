"""Sensor steps, one file each, which declares a `Step`. They change rgb pixel by pixel after resolving.

A file is found by its name.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step: its inputs, and its function of a channel of a pixel."""

    uniforms: tuple[str, ...] = ()
    """numbers of the view (`View.uniform`) which fill `numbers`, in this order"""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """name in `s`: type"""
    arrays: Mapping[str, Any] = field(default_factory=dict)
    """arrays of the view (`View.array`): name in `s`: type of an element"""
    apply: Any
    """(v, x, y, channel, s): returns the channel's value after the step; s: a struct with the numbers and
    arrays of all steps"""


def known() -> frozenset[str]:
    """Names of all files."""
    return frozenset(module.name for module in pkgutil.iter_modules(__path__))


def declared(name: str) -> Step:
    """The declaration in the file of this name."""
    return import_module(f".{name}", __name__).STEP
