"""Declarations of effects and outputs, and selection of the effects that a frame requires."""

from fidsplat.effects.catalogue import CATALOGUE, IMAGES, OUTPUTS, Effect, Output, declared_output
from fidsplat.effects.extensions import Extension, load_extensions, register
from fidsplat.effects.select import FeatureSet, select

__all__ = [
    "CATALOGUE",
    "IMAGES",
    "OUTPUTS",
    "Effect",
    "Extension",
    "FeatureSet",
    "Output",
    "declared_output",
    "load_extensions",
    "register",
    "select",
]
