"""Interleaved frames of fidsplat and another renderer, so that disturbances affect both."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.progress import Progress

import fidsplat as fs
from fidsplat.backends.interface import DeviceInfo
from fidsplat.experiments.bench.measure import Result, SceneRun
from fidsplat.util.timing import Timer, time_interleaved

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from measuring import PROGRESS, keep, options, show


def arguments(about: str | None, repeats: int, device: str) -> argparse.ArgumentParser:
    """Parser of the comparison scripts; --device is fidsplat's device."""
    parser = options(about, device, repeats)
    parser.add_argument("scenes", nargs="*", default=["r100k_720p"], help="as in `fidsplat bench --help`")
    return parser


def peer_device(name: str, title: str, platform: str, version: str, kind: str, units: int) -> DeviceInfo:
    """Device of the other renderer."""
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
    """Time both renderers; returns their records, the peer's with the ratio of medians and the PSNR of its
    image against fidsplat's.

    Args:
        peer: result whose `timer` times `draw`.
        draw: renders one frame, waits for it, and returns an array-like image (h, w, 3 or more); its
        conversion to NumPy is not timed.
    """
    images = []
    peer.first_frame_ms = Timer(lambda: images.append(np.asarray(draw())[..., :3])).run()
    image = images.pop()
    peer.mean_rgb = float(image.mean(dtype=np.float64))
    error = np.mean((np.clip(image, 0, 1).astype(np.float64) - np.clip(ours.image, 0, 1)) ** 2)
    with Progress(console=PROGRESS) as progress:
        task = progress.add_task(peer.scene, total=2 * repeats)
        time_interleaved([ours.result.timer, peer.timer], repeats, tick=lambda: progress.advance(task))
    records = [ours.result.as_dict(), peer.as_dict()]
    records[1]["times_ours"] = records[1]["frame_ms"] / records[0]["frame_ms"]
    records[1]["psnr_db"] = -10 * math.log10(max(error, 1e-12))
    return records


def report(records: list[dict], scenes: list[str], file: str | None) -> None:
    """Print a table, or write the file in the format of `fidsplat bench --json`."""
    figures = {"fidsplat": fs.__version__, "scenes": scenes, "interrupted": False, "results": records}
    if keep(figures, file):
        return

    def cells(record: dict) -> tuple[str, ...]:
        low, high = record["quartiles_ms"]
        times, psnr = record.get("times_ours"), record.get("psnr_db")
        return (
            record["scene"],
            record["renderer"],
            record["title"],
            f"{record['frame_ms']:.2f} ({low:.2f} to {high:.2f})",
            "" if times is None else f"{times:.1f}",
            f"{record['mean_rgb']:.4f}",
            "" if psnr is None else f"{psnr:.1f} dB",
        )

    heads = ("scene", "renderer", "device", "ms per frame", "times ours", "mean RGB", "PSNR against ours")
    show("fidsplat and the other renderer, interleaved", heads, map(cells, records))
