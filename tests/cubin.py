"""Resources of a kernel on an NVIDIA GPU, from its machine code; no GPU is needed."""

import struct

_REGISTERS, _FRAME = 0x2F, 0x11


def resources_of(cubin: bytes) -> dict[str, int]:
    """`registers`, and bytes of `stack`, of the largest function of a cubin: an ELF file whose sections
    `.nv.info` hold (form, attribute, size, symbol, value) of each.
    """
    (headers,) = struct.unpack_from("<Q", cubin, 0x28)
    size, count, names = struct.unpack_from("<HHH", cubin, 0x3A)
    sections = [struct.unpack_from("<IIQQQQ", cubin, headers + k * size) for k in range(count)]
    actual = {_REGISTERS: 0, _FRAME: 0}
    for name, _, _, _, begin, length in sections:
        if cubin[sections[names][4] + name :].startswith(b".nv.info\0"):
            at = begin
            while at < begin + length:
                form, attribute, rest = struct.unpack_from("<BBH", cubin, at)
                if form == 4 and attribute in actual:
                    (value,) = struct.unpack_from("<I", cubin, at + 8)
                    actual[attribute] = max(actual[attribute], value)
                at += 4 + (rest if form == 4 else 0)
    return {"registers": actual[_REGISTERS], "stack": actual[_FRAME]}
