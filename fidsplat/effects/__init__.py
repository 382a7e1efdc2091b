"""What a scene may call for, as data, and the one place that decides what it does call for."""

from fidsplat.effects.catalogue import CATALOGUE, Effect, Output
from fidsplat.effects.select import IMAGES, OUTPUTS, FeatureSet, select

__all__ = ["CATALOGUE", "IMAGES", "OUTPUTS", "Effect", "FeatureSet", "Output", "select"]
