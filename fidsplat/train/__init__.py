"""Training of splats from images with known cameras, on any device with gradients."""

from fidsplat.train.checkpoint import splats_of
from fidsplat.train.dataset import Dataset, TrainingView
from fidsplat.train.dataset_files import load_dataset
from fidsplat.train.memory import splats_within
from fidsplat.train.parameters import TrainingError
from fidsplat.train.refining import RefineStep, refine
from fidsplat.train.scores import ViewScore
from fidsplat.train.settings import TrainSettings
from fidsplat.train.trainer import Step, Trainer

__all__ = [
    "Dataset",
    "RefineStep",
    "Step",
    "TrainSettings",
    "Trainer",
    "TrainingError",
    "TrainingView",
    "ViewScore",
    "load_dataset",
    "refine",
    "splats_of",
    "splats_within",
]
