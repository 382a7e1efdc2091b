"""`fidsplat experiment ...`: the words that may follow."""

from dataclasses import dataclass
from typing import ClassVar

from fidsplat.commands.experiment_files import Blender, Dataset, Merge, Report
from fidsplat.commands.experiment_measure import All, Angles, Counts, Localisation, Pictures, Views


@dataclass
class Experiment:
    """The paper's experiments: its tables and figures with our columns, beside the ideal.

    Each experiment writes one file of results; a run that was stopped goes on where it was.

    Examples:
      fidsplat experiment all --quick                   a rough picture of all of it, in minutes
      fidsplat experiment angles --category small       one experiment, one category
      fidsplat experiment report                        tables, charts and pictures from the results
      fidsplat experiment angles --help                 what one of them does, and its options
    """

    PARTS: ClassVar[dict[str, type]] = {
        "all": All,
        "angles": Angles,
        "views": Views,
        "counts": Counts,
        "localisation": Localisation,
        "pictures": Pictures,
        "dataset": Dataset,
        "blender": Blender,
        "merge": Merge,
        "report": Report,
    }
