"""fidsplat and a peer draw a scene frame by frame in turn, so that what disturbs one disturbs both."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import fidsplat as fs
from fidsplat.backends.base import DeviceInfo
from fidsplat.experiments.bench.measure import Result, SceneRun
from fidsplat.files import atomic_write
from fidsplat.timing import Timer, take_turns


def arguments(about: str | None, repeats: int, device: str) -> argparse.ArgumentParser:
    """What every peer's script takes."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["r100k_720p"], help="as in `fidsplat bench --help`")
    parser.add_argument("--device", default=device, help=f"where fidsplat draws (default: {device})")
    parser.add_argument(
        "--repeats", type=int, default=repeats, help=f"frames that count (default: {repeats})"
    )
    parser.add_argument("--json", metavar="FILE", help="write the figures, as `fidsplat bench --json` does")
    return parser


def peer_device(name: str, title: str, platform: str, version: str, kind: str, units: int) -> DeviceInfo:
    """Where a peer draws."""
    return DeviceInfo(
        name=name,
        title=title,
        platform=platform,
        version=version,
        kind=kind,
        compute_units=units,
        memory_bytes=0,
        largest_allocation_bytes=0,
        float64=True,
        usable=True,
        reason="",
    )


def compared(ours: SceneRun, peer: Result, draw: Callable[[], np.ndarray], repeats: int) -> list[dict]:
    """Time both and return their records, the peer's with the ratio of the medians and the PSNR of its
    picture against ours.

    Args:
        peer: its `timer` times `draw`, which draws one frame, waits until it is done, and returns the
        picture,
            (h, w, 3 or more), as something that NumPy can read. The reading is not timed.
    """
    drawn = []
    peer.first_frame_ms = Timer(lambda: drawn.append(np.asarray(draw())[..., :3])).run()
    picture = drawn.pop()
    peer.mean_rgb = float(picture.mean(dtype=np.float64))
    error = np.mean((np.clip(picture, 0, 1).astype(np.float64) - np.clip(ours.picture, 0, 1)) ** 2)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task(peer.scene, total=2 * repeats)
        take_turns([ours.result.timer, peer.timer], repeats, tick=lambda: progress.advance(task))
    records = [ours.result.as_dict(), peer.as_dict()]
    records[1]["times_ours"] = records[1]["frame_ms"] / records[0]["frame_ms"]
    records[1]["psnr_db"] = -10 * math.log10(max(error, 1e-12))
    return records


def report(records: list[dict], scenes: list[str], file: str | None) -> None:
    """Print a table, and write the file if there is one."""
    table = Table(
        "scene", "renderer", "device", "ms per frame", "times ours", "mean RGB", "PSNR against ours"
    )
    for record in records:
        low, high = record["quartiles_ms"]
        times, psnr = record.get("times_ours"), record.get("psnr_db")
        table.add_row(
            record["scene"],
            record["renderer"],
            record["title"],
            f"{record['frame_ms']:.2f} ({low:.2f} to {high:.2f})",
            "" if times is None else f"{times:.1f}",
            f"{record['mean_rgb']:.4f}",
            "" if psnr is None else f"{psnr:.1f} dB",
        )
    console = Console()
    console.width = max(console.width, 140)  # numbers are not to be broken
    console.print(table)
    if file is not None:
        record = {"fidsplat": fs.__version__, "scenes": scenes, "interrupted": False, "results": records}
        with atomic_write(file) as stream:
            stream.write(json.dumps(record, indent=2).encode() + b"\n")
