"""What `fidsplat fly` makes of its pictures beside them: a log, and their truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fidsplat.images.files import read_image
from fidsplat.render.flight import FlightFolder
from fidsplat.render.output_files import load_output, suffixes_of
from fidsplat.vision.coco import CocoAnnotations
from fidsplat.vision.truth import truth_of

CAMERA = "camera"
"""name of the camera's frame and topics"""


def write_log(folder: FlightFolder, path: str, overwrite: bool) -> Iterator[int]:
    """The pictures as a log: rgb and what is kept as arrays, the camera's intrinsics and pose. Yields the
    number of each once it is in."""
    from fidsplat.logs import RobotLog

    flight = folder.flight
    camera = flight.capture.camera
    assert camera is not None
    # a log's clock starts at 0 or later
    start = min(0.0, float(flight.path.times[0]))
    with RobotLog(path, overwrite=overwrite, source=folder.key) as log:
        for k, (time, pose) in enumerate(zip(flight.path.times, flight.path.poses, strict=True)):
            moment = float(time) - start
            for name, image in _images(folder, k).items():
                log.image(moment, CAMERA, image, name)
            log.camera_info(moment, CAMERA, camera)
            log.transform(moment, CAMERA, pose)
            yield k


def write_truth(folder: FlightFolder, path: str) -> Iterator[int]:
    """What the pictures show, as COCO. Yields the number of each once it is known."""
    annotations, flight = CocoAnnotations(), folder.flight
    for k, capture in enumerate(flight.captures):
        images = _images(folder, k)
        scene = replace(flight.scene, shutter=capture.shutter)
        assert capture.camera is not None
        camera = capture.motion.moved(capture.camera, capture.shutter.time)
        name = flight.capture.outputs[0]
        file = folder.file(k, name, suffixes_of(name)[-1])
        shown = images or {name: read_image(file)}
        annotations.add(str(file.relative_to(folder.folder)), truth_of(shown, scene, camera))
        yield k
    annotations.save(path)


def _images(folder: FlightFolder, k: int) -> dict[str, np.ndarray]:
    """The outputs of a picture that are kept whole: rgb, and arrays."""
    found, camera = {}, folder.flight.capture.camera
    assert camera is not None
    for name in folder.flight.capture.outputs:
        if ".npy" in suffixes_of(name):
            found[name] = load_output(folder.file(k, name, ".npy"), (camera.height, camera.width))
        elif name == "rgb":
            found[name] = read_image(folder.file(k, name, ".png"))
    return found
