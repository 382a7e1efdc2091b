"""Shared code of the tests of the viewer: a scene, and a client that is not a browser."""

import threading
from types import SimpleNamespace

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.viewer.settings import Viewpoint

HERE = Viewpoint((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0), 0.8, 48, 36)
TAG = fs.marker("aruco:4x4_50:7", size=0.4)


def scene(**parts) -> fs.Scene:
    return fs.Scene(markers=[PlacedMarker(TAG)], background=(0.2, 0.3, 0.4), **parts)


class Client(SimpleNamespace):
    """The part of viser's client handle that the server uses."""

    def __init__(self, number=1):
        sent: list = []
        depths: list = []
        message = SimpleNamespace(content="")
        camera = SimpleNamespace(
            position=(0, 0, -1), wxyz=(1, 0, 0, 0), fov=0.8, image_width=48, image_height=36,
            look_at=(0, 0, 0),
            on_update=lambda callback: setattr(self, "turned", callback),
        )  # fmt: skip
        super().__init__(
            client_id=number, sent=sent, depths=depths, said=message, files=[], camera=camera,
            gui=SimpleNamespace(add_folder=lambda _: _Folder(), add_markdown=lambda _: message),
            scene=SimpleNamespace(
                set_background_image=lambda image, kind, depth=None, **_: (
                    depths.append(depth), sent.append((image, kind))
                )
            ),
            send_file_download=lambda name, content: self.files.append((name, content)),
        )  # fmt: skip


class _Folder:
    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def until(condition) -> bool:
    waited = threading.Event()
    for _ in range(400):
        if condition():
            return True
        waited.wait(0.05)
    return False
