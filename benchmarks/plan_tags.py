"""Measure planned tags in the greenhouse: errors of the robot's drive with default and with planned tags.

python benchmarks/plan_tags.py --rows 5 --plants 12 --counts 25 12
"""

import argparse
import json
from dataclasses import dataclass, replace
from unittest import mock

import numpy as np

import fidsplat as fs
from fidsplat.experiments.localise import VARIANTS, Drive
from fidsplat.experiments.plan_tags import PlanSettings, Survey, plan_tags
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.tag_placement import position_error


@dataclass(frozen=True)
class PlannedDrive(Drive):
    """Drive with the planned tags instead of the default ones."""

    placed: tuple[PlacedMarker, ...] = ()

    @property
    def tags(self) -> dict[int, PlacedMarker]:
        return {one.marker.id: one for one in self.placed}

    def scene(self, mixture):
        house = super().scene(mixture)
        others = tuple(one for one in house.markers if one.marker.id is None)
        return replace(house, markers=(*others, *self.placed))


class IndependentSurvey(Survey):
    """Survey of poses with independent errors: the objective of OMP (Huang et al., arXiv 2211.01513), the sum
    over poses of the information of the tags that each one sees."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        poses = len(self.path)
        blocks = np.einsum("aiaj->aij", self.covariance.reshape(poses, 6, poses, 6))
        self.covariance = np.kron(np.eye(poses), blocks.mean(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=5)
    parser.add_argument("--plants", type=int, default=12)
    parser.add_argument("--counts", type=int, nargs="*", default=[25])
    parser.add_argument(
        "--objectives", nargs="*", default=["information"], help="information, error, omp (independent poses)"
    )
    parser.add_argument("--walls", action="store_true")
    parser.add_argument(
        "--seeds", type=int, default=1, help="drives with other errors of wheels and gyroscope"
    )
    parser.add_argument(
        "--corner-noise", type=float, default=0.5, help="pixels, of the filter and of the plan"
    )
    parser.add_argument("--device")
    given = parser.parse_args()
    base = Drive(given.rows, given.plants)
    renderer, run = fs.Renderer(given.device), base.run()
    own = tuple(base.tags.values())
    bare = replace(PlannedDrive(given.rows, given.plants).scene("exact"), camera=base.camera)
    settings = PlanSettings(
        poses=min(200, int(3 * run.length)), views=80, walls=given.walls, planar=True, drift=(0.003, 0.1),
        corner_noise=given.corner_noise,
    )  # fmt: skip
    survey = Survey(bare, run.camera, settings, renderer)
    layouts = {f"greenhouse's {len(own)}": own}
    for count in given.counts:
        for objective in given.objectives:
            known = "information" if objective == "omp" else objective
            wanted = replace(settings, count=count, objective=known)
            kind = IndependentSurvey if objective == "omp" else Survey
            with mock.patch("fidsplat.experiments.plan_tags.Survey", kind):
                plan = plan_tags(bare, run.camera, wanted, renderer)
            layouts[f"{count}, {objective}"] = plan.tags
        some = np.linspace(0, len(own) - 1, count).round().astype(int)
        layouts[f"every {len(own) / count:.2g}th"] = tuple(own[k] for k in some)
    runs = [replace(base, seed=seed).run() for seed in range(given.seeds)]
    for name, tags in layouts.items():
        drive = PlannedDrive(given.rows, given.plants, placed=tags)
        codes = list(drive.detections(VARIANTS["exact"], runs[0], renderer))
        found = [drive.localise(one, codes, drive.camera, given.corner_noise)[1] for one in runs]
        keys = ("ate_m", "worst_m", "heading_deg", "tags")
        facts = {key: float(np.mean([one[key] for one in found])) for key in keys}
        predicted = position_error(survey.with_tags(tags))
        print(json.dumps({"layout": name, "predicted_m": predicted} | facts), flush=True)


if __name__ == "__main__":
    main()
