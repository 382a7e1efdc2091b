"""Construction time of markers."""

import random
import string

import pytest

from fidsplat.markers import marker

TEXT = "".join(random.Random(0).choices(string.ascii_letters, k=1000))
SPECS = {
    "apriltag": "apriltag:36h11:5",
    "aruco": "aruco:4x4_50:7",
    "qr v2": f"qr-v2-L:{TEXT[:20]}",
    "qr v10": f"qr-v10-L:{TEXT[:250]}",
    "qr v22": f"qr-v22-L:{TEXT}",
    "qr v40": f"qr-v40-L:{TEXT}",
}


@pytest.mark.benchmark(group="marker")
@pytest.mark.parametrize("mixture", ["fitted", "paper"])
@pytest.mark.parametrize("kind", SPECS)
def test_marker(benchmark, kind, mixture):
    made = benchmark.pedantic(
        marker, (SPECS[kind],), {"mixture": mixture}, rounds=5, warmup_rounds=1, iterations=1
    )
    benchmark.extra_info |= {"rectangles": len(made.rectangles), "splats": len(made.cloud)}
