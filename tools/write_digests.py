"""Replace the table of `fidsplat check --digests` by the digests of a device.

python tools/write_digests.py opencl:pocl
"""

import csv
import sys

import fidsplat as fs
from fidsplat.selftest.digests import COUNT, OUTPUTS, TABLE, digest_of

if __name__ == "__main__":
    renderer = fs.Renderer(sys.argv[1])
    with TABLE.open("w", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["seed", "sha256", *OUTPUTS])
        for seed in range(COUNT):
            digest = digest_of(renderer, seed)
            table.writerow([seed, digest.sha256, *digest.outputs.values()])
