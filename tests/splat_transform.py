"""splat-transform, PlayCanvas' converter of splat files, as a foreign reader and writer.

`npm install -g @playcanvas/splat-transform` (Node 22; @2.7.1 for Node 18), or SPLAT_TRANSFORM with its path.
"""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

COMMAND = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
REASON = "no splat-transform: npm install -g @playcanvas/splat-transform"
NEEDED = pytest.mark.skipif(COMMAND is None, reason=REASON)


def version() -> int:
    """Major version of splat-transform."""
    actual = re.search(r"splat-transform v(\d+)", _run("--version"))
    assert actual is not None
    return int(actual[1])


def transform(*words: object) -> None:
    """Run splat-transform with input files, actions and an output file."""
    _run("-q", "-w", "-g", "cpu", *map(str, words))


def converted(source: Path, target: Path) -> Path:
    """A file converted by splat-transform."""
    transform(source, target)
    return target


def _run(*words: str) -> str:
    assert COMMAND is not None
    start = ["node", COMMAND] if COMMAND.endswith("mjs") else [COMMAND]
    done = subprocess.run([*start, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr
