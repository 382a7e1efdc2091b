"""Large memory pages, on systems that support them."""

import ctypes
import mmap


def large_pages(address: int, size: int) -> bool:
    """Advise the system to use large pages for a range of memory from its first use on.

    Args:
        address, size: in bytes; rounded inwards to complete pages.

    Returns:
        Whether the system accepted. Memory contents are unchanged.
    """
    advice = getattr(mmap, "MADV_HUGEPAGE", None)  # only on Linux
    first = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
    end = (address + size) // mmap.PAGESIZE * mmap.PAGESIZE
    if advice is None or end <= first:
        return False
    return ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), advice) == 0
