"""Replace the table of `fidsplat check --digests` by the digests of a device.

python tools/write_digests.py opencl:pocl
"""

import sys

import fidsplat as fs
from fidsplat.selftest.digests import write_table

if __name__ == "__main__":
    write_table(fs.Renderer(sys.argv[1]))
