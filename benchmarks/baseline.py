"""Train the paper's baseline: 2DGS on 3, 5, 9 and 17 views of each marker.

    python benchmarks/paper_dataset.py -o DATASET
    python benchmarks/baseline.py DATASET -o DIR [--device opencl] [--iterations 7000] [--seed 0]
    fidsplat experiment views --trained DIR -o DIR
    fidsplat experiment angles --trained DIR -o DIR

Writes DIR/2dgs-17/small-0.ply and so on. Existing files are kept, and an interrupted training resumes. The
table has seconds, splats, and PSNR and SSIM of the 20 test views of each marker.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS, MARKERS
from fidsplat.train import Trainer, load_dataset
from fidsplat.util.files import writable_folder


def train(scene: Path, file: Path, renderer: fs.Renderer, iterations: int, seed: int) -> dict:
    """Train on a scene and write the splats; an interrupted training resumes from its checkpoint."""
    writable_folder(file.parent)
    checkpoint = file.with_suffix(".training.npz")
    trainer = Trainer(load_dataset(scene), renderer, checkpoint=checkpoint, iterations=iterations, seed=seed)
    begun = time.perf_counter()
    trainer.run(prompt=False)
    seconds = time.perf_counter() - begun
    trainer.save(file)
    scores = trainer.evaluate()
    checkpoint.unlink(missing_ok=True)
    means = {name: float(np.mean([getattr(score, name) for score in scores])) for name in ("psnr", "ssim")}
    return {"scene": scene.name, "seconds": seconds, "splats": len(trainer.cloud()), **means}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("dataset", type=Path, help="folder of benchmarks/paper_dataset.py")
    parser.add_argument("-o", "--out", type=Path, default=Path("fidsplat-baseline"))
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    renderer, found = fs.Renderer(given.device), []
    for index in range(MARKERS):  # one marker of each category first
        for category in CATEGORIES:
            for views in COLLECTIONS:
                scene = given.dataset / f"{category}-{index}-views-{views}"
                file = given.out / f"2dgs-{views}" / f"{category}-{index}.ply"
                if scene.is_dir() and not file.exists():
                    found.append(train(scene, file, renderer, given.iterations, given.seed))
    if not keep({"facts": facts(renderer), "trainings": found}, given.json):
        heads = ("scene", "seconds", "splats", "PSNR, dB", "SSIM")
        rows = [
            (r["scene"], f"{r['seconds']:.1f}", f"{r['splats']:,}", f"{r['psnr']:.1f}", f"{r['ssim']:.3f}")
            for r in found
        ]
        show("The paper's baseline", heads, rows)


if __name__ == "__main__":
    main()
