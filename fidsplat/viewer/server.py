"""The page: viser's server, a stream for each browser, and what they do."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import threading
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.backends import devices
from fidsplat.cameras import Trajectory
from fidsplat.formats import save_trajectory
from fidsplat.images.files import png_bytes
from fidsplat.scenes import Scene
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.markdown import escaped
from fidsplat.viewer.controls import NOBODY, Controls
from fidsplat.viewer.edits import Body, SceneFile
from fidsplat.viewer.guard import guarded
from fidsplat.viewer.held import Held, held_by, movable
from fidsplat.viewer.nodes import Nodes
from fidsplat.viewer.session import Session, View
from fidsplat.viewer.settings import Viewpoint
from fidsplat.viewer.stream import Stream
from fidsplat.vision.readback import read_back

LOOK = 1.0
"""seconds between two looks at the scene file"""
JPEG = 75
"""quality of pictures while moving; at rest they are PNG, without a loss"""


def check_port(host: str, port: int) -> None:
    """Raises InputError where the port cannot be had: viser would take the next one in silence; likewise for
    a port that is none, and a host that is empty, by which the whole network would be let in."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port is {port}; give a number from 1 to 65535, or 0 for any that is free")
    if not host:
        raise InputError("--host is empty; give an address to listen on, 127.0.0.1 for this machine alone")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        of_host = isinstance(error, (socket.gaierror, UnicodeError)) or error.args[0] == errno.EADDRNOTAVAIL
        remedy = "--host must be an address of this machine" if of_host else "give another --port"
        raise InputError(f"cannot listen on {host}, port {port}: {why}; {remedy}") from None


class Viewer:
    """A scene in the browsers that look at it.

    Args:
        scene: what is shown.
        file: the scene file that it is of: read again when it changes, and written when a marker is moved.
        device, memory_budget: as `Session`.
        host: 127.0.0.1, which nobody else reaches, unless told otherwise.
        port: 0 takes a free one.
        rate: pictures a second to aim at while moving.
        keyframes: whose poses, camera to world, stand there at first.
        reload: called once a second; returns a newer scene of a running training, or None.
        quality: instead of the scene file's, when it is read again.

    Raises:
        InputError: the port is in use, or the extra `viewer` is missing.
        DeviceError: the device cannot be used.
    """

    def __init__(
        self,
        scene: Scene,
        file: Path | None = None,
        device: str | None = None,
        memory_budget: int | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        rate: float = 30.0,
        keyframes: Trajectory | None = None,
        reload: Callable[[], Scene | None] | None = None,
        quality: str | None = None,
    ) -> None:
        viser = _viser()
        check_port(host, port)
        self._rate, self._lock = rate, threading.Lock()
        self._streams: dict[int, Stream] = {}
        self._views: dict[int, View] = {}
        self._said: dict[int, Any] = {}
        self._keyframes: list[np.ndarray] = [] if keyframes is None else list(keyframes.poses)
        self._file = None if file is None else SceneFile(file)
        self._reload, self._quality = reload, quality
        self._held: Held | None = None
        self._saved: Path | None = None
        self.session = Session(scene, device, memory_budget, self._changed)
        with _silent():
            self.server: Any = guarded(
                lambda: viser.ViserServer(host, port, label="fidsplat", verbose=False), host
            )
        if port and self.server.get_port() != port:  # taken by another since it was looked at
            with _silent():
                self.server.stop()
            self.session.close()
            check_port(host, port)
            raise InputError(f"cannot listen on {host}, port {port}: it was in use; give another --port")
        self.server.gui.configure_theme(dark_mode=True, show_logo=False)
        self.server.gui.main_panel.dock_right()
        self._nodes = Nodes(self.server.scene)
        own = self.session.drawn.device
        names = [d.name for d in devices() if d.usable and not d.always_float64]
        self._controls = Controls(self.server.gui, self.session, list(dict.fromkeys([own, *names])), self)
        self._start_camera(scene)
        self._nodes.show(scene, self._overlay)
        self._nodes.show_keyframes(scene.camera, self._keyframes)
        self.server.on_client_connect(self._enter)
        self.server.on_client_disconnect(self._leave)
        self.server.scene.on_click()(self._click)
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="viewer file", daemon=True)
        self._watcher.start()

    @property
    def address(self) -> str:
        """Where browsers find it."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self) -> None:
        """Let all go."""
        self._closed.set()
        for stream in list(self._streams.values()):
            stream.close()
        self.session.close()
        with _silent():
            self.server.stop()

    # browsers come and go

    def _enter(self, client: Any) -> None:
        with client.gui.add_folder("What is seen"):
            self._said[client.client_id] = client.gui.add_markdown("Click into the picture.")
        stream = Stream(
            lambda viewpoint, scale: self._draw(client, viewpoint, scale),
            lambda viewpoint: self._send_exact(client, viewpoint),
            self._controls.say,
            self._rate,
        )
        self._streams[client.client_id] = stream
        client.camera.on_update(lambda camera: self._look(stream, camera))
        threading.Thread(target=stream.run, name=f"viewer stream {client.client_id}", daemon=True).start()
        self._look(stream, client.camera)

    def _look(self, stream: Stream, camera: Any) -> None:
        """Take over a browser's camera; one that no image can be rendered from changes nothing."""
        try:
            stream.look(_viewpoint(camera))
        except FidsplatError as error:
            self._controls.say(str(error))

    def _leave(self, client: Any) -> None:
        stream = self._streams.pop(client.client_id, None)
        if stream is not None:
            stream.close()
        self._views.pop(client.client_id, None)
        self._said.pop(client.client_id, None)

    def _draw(self, client: Any, viewpoint: Viewpoint, scale: float) -> Callable[[], None]:
        image = self.session.draw_moving(viewpoint, scale).to_uint8()
        return partial(client.scene.set_background_image, image, "jpeg", jpeg_quality=JPEG)

    def _send_exact(self, client: Any, viewpoint: Viewpoint) -> None:
        view = self.session.draw(viewpoint)
        client.scene.set_background_image(view.frame.to_uint8(), "png")
        if client.client_id in self._streams:  # else it has left meanwhile
            self._views[client.client_id] = view

    def _changed(self) -> None:
        """What is drawn has changed."""
        self._nodes.show(self.session.drawn.scene, self._overlay)
        self._refresh()

    def _refresh(self) -> None:
        for stream in list(self._streams.values()):
            stream.refresh()

    @property
    def _overlay(self) -> bool:
        drawn = self.session.drawn
        plain = drawn.scene.camera is None or drawn.scene.camera.lens is None
        return drawn.settings.lens == "pinhole" or (drawn.settings.lens == "scene" and plain)

    def _start_camera(self, scene: Scene) -> None:
        camera = scene.camera
        if camera is None:
            return
        pose, start = np.linalg.inv(camera.world_to_camera), self.server.initial_camera
        start.position = pose[:3, 3]
        start.look_at = pose[:3, 3] + pose[:3, 2] * _distance(scene, pose)
        start.up = -pose[:3, 1]
        start.fov = float(2 * np.arctan(camera.height / 2 / camera.fy)) if camera.lens is None else 1.0
        start.near, start.far = max(camera.near, 1e-3), min(camera.far, 1e4)
        self.server.scene.set_up_direction(-pose[:3, 1])

    # what the page's buttons do; `Actions`

    def _click(self, event: Any) -> None:
        said, view = self._said.get(event.client_id), self._views.get(event.client_id)
        if said is None:
            return
        if view is None:
            said.content = "Wait until the picture is still, then click again."
            return
        found = view.at(*event.screen_pos)
        depth = "nothing" if found["depth"] is None else f"{found['depth']:.4f} m"
        rows = [f"pixel {found['pixel']}", f"depth {depth}", f"label {found['label']}"]
        rows += [f"splat {found['splat_id']}", f"marker {escaped(found['marker'] or '-')}"]
        said.content = "  \n".join(rows)

    def read(self, client: Any) -> None:
        """Read the markers in the picture at rest, with their errors."""
        said, view = self._said.get(client.client_id), self._views.get(client.client_id)
        if said is None:
            return
        if view is None:
            said.content = "Wait until the picture is still, then ask again."
            return
        try:
            readings, others = read_back(view.frame, view.drawn.scene)
        except FidsplatError as error:
            said.content = escaped(error)
            return
        lines = ["| marker | mm | deg |", "|---|---|---|"]
        for facts in (reading.as_dict() for reading in readings):
            errors = (facts["position_error_mm"], facts["angle_error_deg"])
            cells = ["not read", ""] if errors[0] is None else [f"{value:.2f}" for value in errors]
            lines.append(f"| {escaped(facts['marker'])} | {' | '.join(cells)} |")
        lines += [f"\nnot of the scene: {escaped(code.name)}" for code in others]
        said.content = "\n".join(lines)

    def picture(self, client: Any) -> None:
        """The picture as this browser sees it, for its user to keep."""
        stream = self._streams.get(client.client_id)
        if stream is None:
            return
        try:
            image = self.session.draw(_viewpoint(client.camera)).frame.to_uint8()
        except (FidsplatError, MemoryError) as error:
            self._controls.say(str(error) or "not enough memory for this picture")
            return
        client.send_file_download("fidsplat.png", png_bytes(image))

    def add_keyframe(self, client: Any) -> None:
        """Keep where this browser looks from."""
        try:
            self._keyframes.append(_viewpoint(client.camera).pose)
        except FidsplatError as error:
            self._controls.say(str(error))
        self._nodes.show_keyframes(self.session.drawn.scene.camera, self._keyframes)

    def clear_keyframes(self, client: Any) -> None:
        """Forget them."""
        self._keyframes = []
        self._nodes.show_keyframes(None, [])

    def save_keyframes(self, client: Any) -> None:
        """Write them as a trajectory, a second apart, beside the scene file or into the current folder."""
        if not self._keyframes:
            self._controls.say("no keyframe to save; add some first")
            return
        file = self._saved = self._saved or self._free_name()
        try:
            save_trajectory(Trajectory(range(len(self._keyframes)), np.array(self._keyframes)), file)
            self._controls.say(f"{file}: fidsplat fly SCENE --trajectory {file} --smooth")
        except FidsplatError as error:
            self._controls.say(str(error))

    def _free_name(self) -> Path:
        """Of the file of keyframes; another's is not written over."""
        stem = Path("view") if self._file is None else self._file.path.with_suffix("")
        names = (f"{stem.name}-trajectory{'' if k == 1 else f'-{k}'}.tum" for k in count(1))
        return next(file for name in names if not (file := stem.with_name(name)).exists())

    def movable(self, scene: Scene) -> list[str]:
        """Names of what the gizmo may move."""
        return movable(scene, self._bodies)

    @property
    def _bodies(self) -> list[Body]:
        return [] if self._file is None else self._file.bodies()

    def hold(self, name: str) -> None:
        """Put the gizmo at a marker or a splat file, by its name in the selector."""
        scene, _ = self.session.wanted()
        self._held = None if name == NOBODY else held_by(scene, self._bodies, name)
        if self._held is not None and self._held.moves:
            self._controls.say(f"{name} moves by keyframes; it is not moved by hand")
            self._held = None
        held = self._held
        self._nodes.hold(None if held is None else held.pose, 0.0 if held is None else held.size, self._move)

    def overlay(self, visible: bool) -> None:
        """Show or hide outlines, names and frusta."""
        self._nodes.visible = visible
        self._nodes.show(self.session.drawn.scene, self._overlay)

    def _move(self, pose: np.ndarray, let_go: bool) -> None:
        """The gizmo is dragged; once it is let go its pose is written into the scene file."""
        with self._lock:
            scene, _ = self.session.wanted()
            held = self._held
            if held is None or not (let_go or held.light):
                return
            moved = held.moved(scene, pose)
            if moved is None:
                return
            problem = ""
            if let_go and self._file is not None:
                try:
                    self._file.place(held.number, pose, held.kind)
                except FidsplatError as error:
                    problem = str(error)
                    if held.splats is not None:  # where they are is known from the file alone
                        moved = held.moved(scene, held.pose)
            self.session.wish(scene=moved, done=lambda why: self._controls.say(why or problem))

    def _watch(self) -> None:
        """Read the scene file again when somebody else has written it, and ask for a run's newest splats."""
        while not self._closed.wait(LOOK):
            try:
                if self._reload is not None and (newer := self._reload()) is not None:
                    self.session.wish(scene=newer, done=lambda why: self._controls.say(why or ""))
                with self._lock:
                    text = None if self._file is None else self._file.changed()
                if self._file is not None and text is not None:
                    scene = Scene.load(self._file.path, self._quality)
                    shown, settings = self.session.wanted()
                    settings = settings.following(shown, scene)
                    self.session.wish(scene, settings, partial(self._edited, scene, text))
            except FidsplatError as error:
                self._controls.say(f"{error}; what was read before is shown")

    def _edited(self, scene: Scene, text: str, problem: str | None) -> None:
        """Another scene, of that text, is shown, unless there was a problem. Until then, and while what the
        file holds cannot be shown, no marker is written into it: it may be another's place."""
        if problem is None and self._file is not None:
            with self._lock:
                self._file.text = text
            self.hold(NOBODY)
            self._controls.offer(self.movable(scene))
            self._controls.follow(scene, self.session.wanted()[1])
        self._controls.say(problem or "")


def _silent() -> contextlib.AbstractContextManager[Any]:
    """viser says on stdout where it listens and that it stopped; so do commands, in their own words."""
    return contextlib.redirect_stdout(io.StringIO())


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise InputError("the viewer needs viser; pip install 'fidsplat[viewer]'") from None
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # browsers leave in the middle
    return viser


def _viewpoint(camera: Any) -> Viewpoint:
    """The viewpoint of viser's camera of a browser. Raises InputError for numbers that make none."""
    position, wxyz = np.asarray(camera.position, float), np.asarray(camera.wxyz, float)
    away = float(np.linalg.norm(np.asarray(camera.look_at, float) - position))
    return Viewpoint(
        tuple(position.tolist()),
        tuple(wxyz.tolist()),
        float(camera.fov),
        max(1, camera.image_width),
        max(1, camera.image_height),
        max(away, 1e-3),
    )


def _distance(scene: Scene, pose: np.ndarray) -> float:
    """Metres before the camera about which the page turns: to the nearest marker, else to the middle of the
    splats."""
    targets = [placed.pose[:3, 3] for placed in scene.markers]
    if not targets and isinstance(scene.splats, ChunkedSplats):
        targets = [sum(scene.splats.bounds()) / 2]
    elif not targets and len(cloud := scene.cloud()):
        targets = [np.median(cloud.means, axis=0) + cloud.origin]
    ahead = [float((target - pose[:3, 3]) @ pose[:3, 2]) for target in targets]
    return min((distance for distance in ahead if distance > 0), default=1.0)
