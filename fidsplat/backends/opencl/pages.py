"""Large pages of memory, where the system gives them."""

import ctypes
import mmap


def large_pages(address: int, size: int) -> bool:
    """Asks the system to put what lies there in large pages from its first use on.

    Args:
        address, size: bytes; only whole pages of it are asked for.

    Returns:
        Whether the system took the advice. Contents stay as they are in any case.
    """
    advice = getattr(mmap, "MADV_HUGEPAGE", None)  # Linux alone
    first = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
    end = (address + size) // mmap.PAGESIZE * mmap.PAGESIZE
    if advice is None or end <= first:
        return False
    return ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), advice) == 0
