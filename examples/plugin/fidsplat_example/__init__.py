"""A marker kind with its detector, an output and a sensor step for fidsplat."""

from pathlib import Path

import numpy as np
import zxingcpp

from fidsplat.effects import Extension, Output
from fidsplat.markers import Kind, Spec

HERE, FORMAT = Path(__file__).parent.absolute(), zxingcpp.BarcodeFormat.DataMatrix


def parse(text, head, rest):
    return Spec(text=text, kind="datamatrix", payload=rest)


def bits(spec):
    code = zxingcpp.create_barcode(spec.payload, FORMAT).to_image(scale=1, add_quiet_zones=False)
    return spec, (np.array(code) == 0).astype(np.uint8)


def detect(grey):
    for code in zxingcpp.read_barcodes(grey, formats=FORMAT):
        at = code.position
        corners = [(p.x, p.y) for p in (at.top_left, at.top_right, at.bottom_right, at.bottom_left)]
        yield f"datamatrix:{code.text}", np.array(corners)


DATAMATRIX = Kind("datamatrix", "datamatrix:TEXT", 1, parse, bits, detect=detect)
IMAGE = Output("strongest", 1, "float32", "largest weight of a fragment", "depth")
STRONGEST = Extension("strongest", HERE / "strongest.cl", IMAGE, samples=("strongest_raw",))
TINT = Extension("tint", HERE / "tint.cl", uniforms=("red", "green", "blue"))
