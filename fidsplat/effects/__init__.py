"""Effects and outputs as data, and the selection of those that a frame requires."""

from fidsplat.effects.catalogue import CATALOGUE, IMAGES, OUTPUTS, Effect, Output, declared_output
from fidsplat.effects.select import FeatureSet, select

__all__ = [
    "CATALOGUE",
    "IMAGES",
    "OUTPUTS",
    "Effect",
    "FeatureSet",
    "Output",
    "declared_output",
    "select",
]
