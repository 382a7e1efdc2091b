"""Compression to Zstandard frames, and decompression to a known size."""

from __future__ import annotations

from typing import Any


def compress(data: bytes) -> bytes:
    """Compress to one frame; deterministic."""
    return _library().ZstdCompressor(level=12).compress(data)


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """The content of a frame of `size` bytes. Raises ValueError for damaged data or another size."""
    library = _library()
    try:
        # other calls allocate the size that the frame declares, unchecked
        with library.ZstdDecompressor(max_window_size=2**27).stream_reader(bytes(data)) as stream:
            content = stream.read(size + 1)
    except library.ZstdError as error:
        raise ValueError(str(error)) from None
    if len(content) != size:
        raise ValueError(
            f"a frame must expand to {size} bytes, got {'more' if len(content) > size else len(content)}"
        )
    return content


def _library() -> Any:
    import zstandard

    return zstandard
