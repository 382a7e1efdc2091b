"""A marker kind with its detector, an output and a sensor step for fidsplat."""

from pathlib import Path

import numpy as np
import zxingcpp

from fidsplat.effects import Extension, Output
from fidsplat.markers import Kind, Spec

HERE = Path(__file__).parent.absolute()


def _parse(text: str, head: str, rest: str) -> Spec:
    return Spec(text=text, kind="datamatrix", payload=rest)


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    code = zxingcpp.create_barcode(spec.payload, zxingcpp.BarcodeFormat.DataMatrix)
    image = np.array(code.to_image(scale=1, add_quiet_zones=False))
    return spec, (image == 0).astype(np.uint8)


def _detect(grey: np.ndarray):
    for code in zxingcpp.read_barcodes(grey, formats=zxingcpp.BarcodeFormat.DataMatrix):
        at = code.position
        corners = [(p.x, p.y) for p in (at.top_left, at.top_right, at.bottom_right, at.bottom_left)]
        yield f"datamatrix:{code.text}", np.array(corners)


DATAMATRIX = Kind("datamatrix", "datamatrix:TEXT", 1, _parse, _bits, detect=_detect)
STRONGEST = Extension(
    "strongest",
    HERE / "strongest.cl",
    Output("strongest", 1, "float32", "largest weight of a fragment", "depth"),
    samples=("strongest_raw",),
)
TINT = Extension("tint", HERE / "tint.cl", uniforms=("red", "green", "blue"))
