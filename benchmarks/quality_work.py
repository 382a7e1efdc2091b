"""What there is to draw in the standard quality over the constants that peers share: pairs of splats and
tiles, and fragments that are composited. They are counts, the same on every machine: what the price of a
quality follows from.

    python benchmarks/quality_work.py r100k_720p r1m_1080p r5m_1080p --device opencl [--json FILE]
"""

from __future__ import annotations

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.experiments.bench.measure import overdraw
from fidsplat.random_clouds import SCENES, load_scene

QUALITIES = {"peers": TIMED, "standard": fs.Quality()}


def measure(renderer: fs.Renderer, name: str) -> dict:
    """Both counts of a scene in both qualities."""
    cloud, camera = load_scene(name)
    resident = renderer.upload(cloud)
    record: dict = {"scene": name}
    for word, quality in QUALITIES.items():
        drawn = overdraw(renderer, resident, camera, quality)
        pairs = renderer.render(resident, fs.Capture(camera, quality=quality)).stats["pairs"]
        record[word] = {"fragments": int(drawn.sum(dtype=np.int64)), "pairs": pairs}
    return record


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scenes", nargs="+", choices=[*SCENES], metavar="SCENE")
    given = parser.parse_args()
    renderer = fs.Renderer(given.device)
    records = [measure(renderer, name) for name in given.scenes]
    if keep([facts(renderer) | record for record in records], given.json):
        return
    rows = []
    for record in records:
        before, now = record["peers"], record["standard"]
        ratios = (f"{now[kind] / before[kind]:.3f}" for kind in ("fragments", "pairs"))
        rows.append((record["scene"], f"{before['fragments']:,}", f"{now['fragments']:,}", *ratios))
    show(
        "standard quality over peers' constants",
        ("scene", "fragments before", "now", "times", "pairs, times"),
        rows,
    )


if __name__ == "__main__":
    main()
