"""Downloads of files with a known size and checksum."""

from __future__ import annotations

import hashlib
import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write

_BLOCK, _SECONDS = 2**18, 30
"""bytes of a read, and seconds without data after which a download fails"""


def download(
    url: str, target: Path, size: int, sha256: str, progress: Callable[[int], None] = lambda _: None
) -> Path:
    """Download a file unless it exists, check its size and SHA-256, and return its path.

    progress: called with the number of bytes of each block.
    """
    if target.is_file() and target.stat().st_size == size:
        progress(size)
        return target
    digest, received = hashlib.sha256(), 0
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with urllib.request.urlopen(url, timeout=_SECONDS) as source, atomic_write(target) as stream:
            while received <= size and (block := source.read(_BLOCK)):
                interrupts.check()
                received += len(block)
                digest.update(block)
                stream.write(block)
                progress(len(block))
            if received != size or digest.hexdigest() != sha256:
                raise InputError(
                    f"{url} must have {size:,} bytes and the SHA-256 {sha256}, got {received:,} and "
                    f"{digest.hexdigest()}; the file has changed or a proxy has replaced it"
                )
    except (OSError, ValueError, http.client.HTTPException) as error:  # urllib's errors are OSErrors
        reason = getattr(error, "reason", None) or error
        raise InputError(f"cannot download {url}: {reason}; is the network reachable?") from None
    return target
