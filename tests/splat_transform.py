"""splat-transform, PlayCanvas' converter of splat files, as a foreign reader and writer.

`npm install -g @playcanvas/splat-transform@2.7.1`, or SPLAT_TRANSFORM with the path of its cli.mjs. Its WebP
encoder and its clustering run on the processor.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

COMMAND = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
NEEDED = pytest.mark.skipif(
    COMMAND is None,
    reason="splat-transform is not installed: npm install -g @playcanvas/splat-transform@2.7.1",
)


def transform(*words: object) -> None:
    """Run splat-transform with input files, actions and an output file."""
    assert COMMAND is not None
    start = ["node", COMMAND] if COMMAND.endswith("mjs") else [COMMAND]
    done = subprocess.run(
        [*start, "-q", "-w", "-g", "cpu", "--max-workers", "0", *map(str, words)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def converted(source: Path, target: Path) -> Path:
    """A file converted by splat-transform."""
    transform(source, target)
    return target
