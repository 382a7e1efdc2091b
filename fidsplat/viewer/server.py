"""The viewer's page: viser's server, an image stream for each browser, and the actions of the controls."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.backends import devices
from fidsplat.cameras import Trajectory
from fidsplat.formats import save_trajectory
from fidsplat.images.files import encode_png
from fidsplat.markers import marker
from fidsplat.scenes import Scene
from fidsplat.scenes.write import marker_block
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.util.arguments import settings_with
from fidsplat.util.errors import FidsplatError, InputError, required_package
from fidsplat.util.markup import escaped
from fidsplat.viewer.controls import NO_TARGET, Controls
from fidsplat.viewer.guard import guarded
from fidsplat.viewer.nodes import GizmoTarget, Nodes, find_target, target_names
from fidsplat.viewer.scene_file import SceneFile, SplatFile
from fidsplat.viewer.session import Session, StillImage
from fidsplat.viewer.settings import PageSettings, Viewpoint
from fidsplat.viewer.stream import Stream
from fidsplat.vision.readback import read_back

POLL_INTERVAL = 1.0
"""seconds between two checks of the scene file"""
DEPTH_RANGE = 167.0
"""largest depth in viser's encoding [m]; larger depths would occlude overlays behind this distance"""
JPEG = 75
"""JPEG quality of images while moving; images at rest are lossless PNG"""


def check_port(host: str, port: int) -> None:
    """Raise InputError for a port that is invalid or in use, for which viser would silently use another one,
    and for an empty host, which would open the page to the network."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port must be 1 to 65535, or 0 for any free port, got {port}")
    if not host:
        raise InputError("--host must be an address, got ''; 127.0.0.1 is this machine only")
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
    """An interactive view of a scene in one or more browsers.

    Args:
        scene: scene to show.
        file: scene file of the scene; loaded again when it changes, and written when a marker is moved.
        device, memory_budget: see `Session`.
        page: address and frame rate; None: the defaults. `changes` are its fields: port, host, rate.
        keyframes: camera-to-world poses shown as keyframes.
        reload: called once a second; returns a newer scene of a running training, or None.
        quality: quality that replaces the scene file's when it is loaded again.

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
        page: PageSettings | None = None,
        keyframes: Trajectory | None = None,
        reload: Callable[[], Scene | None] | None = None,
        quality: str | None = None,
        **changes: Any,
    ) -> None:
        viser, page = _viser(), settings_with(PageSettings, page, changes)
        host, port = page.host, page.port
        check_port(host, port)
        self._rate, self._lock = page.rate, threading.Lock()
        self._streams: dict[int, Stream] = {}
        self._views: dict[int, StillImage] = {}
        self._messages: dict[int, Any] = {}
        self._keyframes: list[np.ndarray] = [] if keyframes is None else list(keyframes.poses)
        self._file = None if file is None else SceneFile(file)
        self._reload, self._quality = reload, quality
        self._target: GizmoTarget | None = None
        self._saved: Path | None = None
        self.session = Session(scene, device, memory_budget, self._changed)
        with _silent():
            self.server: Any = guarded(
                lambda: viser.ViserServer(host, port, label="fidsplat", verbose=False), host
            )
        if port and self.server.get_port() != port:  # taken by another process since the check
            with _silent():
                self.server.stop()
            self.session.close()
            check_port(host, port)
            raise InputError(f"cannot listen on {host}, port {port}: it was in use; give another --port")
        self.server.gui.configure_theme(dark_mode=True, show_logo=False)
        self.server.gui.main_panel.dock_right()
        self._nodes = Nodes(self.server.scene)
        own = self.session.state.device
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
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop the streams, the session and the server."""
        self._closed.set()
        for stream in list(self._streams.values()):
            stream.close()
        self.session.close()
        with _silent():
            self.server.stop()

    # connections

    def _enter(self, client: Any) -> None:
        with client.gui.add_folder("Pixel"):
            self._messages[client.client_id] = client.gui.add_markdown("Click into the image.")
        stream = Stream(
            lambda viewpoint, scale: self._render_moving(client, viewpoint, scale),
            lambda viewpoint: self._send_exact(client, viewpoint),
            self._controls.show_status,
            self._rate,
        )
        self._streams[client.client_id] = stream
        client.camera.on_update(lambda camera: self._set_camera(stream, camera))
        threading.Thread(target=stream.run, name=f"viewer stream {client.client_id}", daemon=True).start()
        self._set_camera(stream, client.camera)

    def _set_camera(self, stream: Stream, camera: Any) -> None:
        """Set the viewpoint to a browser's camera; an invalid camera is reported and ignored."""
        try:
            stream.set_viewpoint(_viewpoint(camera))
        except FidsplatError as error:
            self._controls.show_status(str(error))

    def _leave(self, client: Any) -> None:
        stream = self._streams.pop(client.client_id, None)
        if stream is not None:
            stream.close()
        self._views.pop(client.client_id, None)
        self._messages.pop(client.client_id, None)

    def _render_moving(self, client: Any, viewpoint: Viewpoint, scale: float) -> Callable[[], None]:
        image = self.session.render_moving(viewpoint, scale).to_uint8()
        return partial(client.scene.set_background_image, image, "jpeg", jpeg_quality=JPEG)

    def _send_exact(self, client: Any, viewpoint: Viewpoint) -> None:
        view = self.session.render(viewpoint)
        shown = self._overlay and self._nodes.within(viewpoint.position, DEPTH_RANGE)
        depth = view.occluding_depth() if shown else None
        client.scene.set_background_image(view.frame.to_uint8(), "png", depth=depth)
        if client.client_id in self._streams:  # else it has disconnected
            self._views[client.client_id] = view

    def _changed(self) -> None:
        """Update the overlays and images after a change of the state."""
        self._nodes.show(self.session.state.scene, self._overlay)
        self._refresh()

    def _refresh(self) -> None:
        for stream in list(self._streams.values()):
            stream.refresh()

    @property
    def _overlay(self) -> bool:
        state = self.session.state
        plain = state.scene.camera is None or state.scene.camera.lens is None
        return state.settings.lens == "pinhole" or (state.settings.lens == "scene" and plain)

    def _start_camera(self, scene: Scene) -> None:
        camera = scene.camera
        if camera is None:
            return
        pose, start = np.linalg.inv(camera.world_to_camera), self.server.initial_camera
        start.position = pose[:3, 3]
        start.look_at = pose[:3, 3] + pose[:3, 2] * _distance(scene, pose)
        start.up = up = _upright(pose)
        start.fov = float(2 * np.arctan(camera.height / 2 / camera.fy)) if camera.lens is None else 1.0
        start.near, start.far = max(camera.near, 1e-3), min(camera.far, 1e4)
        self.server.scene.set_up_direction(up)

    # actions of the buttons (`Actions`)

    def _click(self, event: Any) -> None:
        message, view = self._messages.get(event.client_id), self._views.get(event.client_id)
        if message is None:
            return
        if view is None:
            message.content = "Wait for the exact image, then click again."
            return
        if self._controls.new_marker is not None:
            message.content = self._place(view, *event.screen_pos)
            return
        picked = view.pick(*event.screen_pos)
        depth = "nothing" if picked["depth"] is None else f"{picked['depth']:.4f} m"
        rows = [f"pixel {picked['pixel']}", f"depth {depth}", f"label {picked['label']}"]
        rows += [f"splat {picked['splat_id']}", f"marker {escaped(picked['marker'] or '-')}"]
        message.content = "  \n".join(rows)

    def _place(self, view: StillImage, x: float, y: float) -> str:
        """Place a new marker on the surface at a position in the image, 0 to 1, and append it to the scene
        file. Returns the message for the page."""
        assert self._controls.new_marker is not None
        try:
            placed = view.place(marker(*self._controls.new_marker), x, y)
            with self._lock:
                scene, _ = self.session.requested()
                scene = replace(scene, markers=(*scene.markers, placed))
                folder = Path() if self._file is None else self._file.path.parent
                block = marker_block(placed, folder, scene.quality)
                if self._file is not None:
                    self._file.add_marker(block)
        except FidsplatError as error:
            return escaped(error)
        self._controls.end_placing()
        self._controls.offer_targets(self.target_names(scene))
        self.session.request(scene=scene, done=lambda why: self._controls.show_status(why or ""))
        where = "Add to a scene file" if self._file is None else f"Appended to {self._file.path.name}"
        return f"{escaped(where)}:\n```toml\n{block}```"

    def detect_markers(self, client: Any) -> None:
        """Detect the markers in the exact image and show their errors."""
        message, view = self._messages.get(client.client_id), self._views.get(client.client_id)
        if message is None:
            return
        if view is None:
            message.content = "Wait for the exact image, then detect again."
            return
        try:
            readings, others = read_back(view.frame, view.state.scene)
        except FidsplatError as error:
            message.content = escaped(error)
            return
        lines = ["| marker | mm | deg |", "|---|---|---|"]
        for facts in (reading.as_dict() for reading in readings):
            errors = (facts["position_error_mm"], facts["angle_error_deg"])
            cells = ["not read", ""] if errors[0] is None else [f"{value:.2f}" for value in errors]
            lines.append(f"| {escaped(facts['marker'])} | {' | '.join(cells)} |")
        lines += [f"\nnot in the scene: {escaped(code.name)}" for code in others]
        message.content = "\n".join(lines)

    def save_image(self, client: Any) -> None:
        """Download the image of this browser's viewpoint as PNG."""
        stream = self._streams.get(client.client_id)
        if stream is None:
            return
        try:
            image = self.session.render(_viewpoint(client.camera)).frame.to_uint8()
        except (FidsplatError, MemoryError) as error:
            self._controls.show_status(str(error) or "not enough memory for this image")
            return
        client.send_file_download("fidsplat.png", encode_png(image))

    def add_keyframe(self, client: Any) -> None:
        """Add this browser's viewpoint as a keyframe."""
        try:
            self._keyframes.append(_viewpoint(client.camera).pose)
        except FidsplatError as error:
            self._controls.show_status(str(error))
        self._nodes.show_keyframes(self.session.state.scene.camera, self._keyframes)

    def clear_keyframes(self, client: Any) -> None:
        self._keyframes = []
        self._nodes.show_keyframes(None, [])

    def save_keyframes(self, client: Any) -> None:
        """Write the keyframes as a trajectory, one second apart, next to the scene file or to the current
        folder."""
        if not self._keyframes:
            self._controls.show_status("no keyframe to save; add some first")
            return
        file = self._saved = self._saved or self._free_name()
        try:
            save_trajectory(Trajectory(range(len(self._keyframes)), np.array(self._keyframes)), file)
            self._controls.show_status(f"{file}: fidsplat fly SCENE --trajectory {file} --smooth")
        except FidsplatError as error:
            self._controls.show_status(str(error))

    def _free_name(self) -> Path:
        """A new file for the keyframes; an existing one is not overwritten."""
        stem = Path("view") if self._file is None else self._file.path.with_suffix("")
        names = (f"{stem.name}-trajectory{'' if k == 1 else f'-{k}'}.tum" for k in count(1))
        return next(file for name in names if not (file := stem.with_name(name)).exists())

    def target_names(self, scene: Scene) -> list[str]:
        """Names of the markers and splat files that the gizmo can move."""
        return target_names(scene, self._splat_files)

    @property
    def _splat_files(self) -> list[SplatFile]:
        return [] if self._file is None else self._file.splat_files()

    def select_target(self, name: str) -> None:
        """Show the gizmo at a marker or a splat file, given by its name in the selector."""
        scene, _ = self.session.requested()
        self._target = None if name == NO_TARGET else find_target(scene, self._splat_files, name)
        if self._target is not None and self._target.animated:
            self._controls.show_status(f"{name} is moved by keyframes, not by hand")
            self._target = None
        target = self._target
        self._nodes.show_gizmo(
            None if target is None else target.pose, 0.0 if target is None else target.size, self._move
        )

    def overlay(self, visible: bool) -> None:
        """Show or hide outlines, names and frusta."""
        self._nodes.visible = visible
        self._nodes.show(self.session.state.scene, self._overlay)
        self._refresh()  # images include the depth that occludes overlays only if these are visible

    def _move(self, pose: np.ndarray, released: bool) -> None:
        """Move the selected marker or cloud while its gizmo is dragged; on release write its pose to the
        scene file."""
        with self._lock:
            scene, _ = self.session.requested()
            target = self._target
            if target is None or not (released or target.live):
                return
            moved = target.moved(scene, pose)
            if moved is None:
                return
            problem = ""
            if released and self._file is not None:
                try:
                    self._file.write_pose(target.number, pose, target.kind)
                except FidsplatError as error:
                    problem = str(error)
                    if target.splats is not None:  # the next move starts at the position in the file
                        moved = target.moved(scene, target.pose)
            self.session.request(scene=moved, done=lambda why: self._controls.show_status(why or problem))

    def _watch(self) -> None:
        """Poll the scene file for changes by other programs, and `reload` for newer splats; load both."""
        while not self._closed.wait(POLL_INTERVAL):
            try:
                if self._reload is not None and (newer := self._reload()) is not None:
                    self.session.request(scene=newer, done=lambda why: self._controls.show_status(why or ""))
                with self._lock:
                    text = None if self._file is None else self._file.changed()
                if self._file is not None and text is not None:
                    scene = Scene.load(self._file.path, self._quality)
                    shown, settings = self.session.requested()
                    settings = settings.updated_from(shown, scene)
                    self.session.request(scene, settings, partial(self._edited, scene, text))
            except FidsplatError as error:
                self._controls.show_status(f"{error}; the previous scene is shown")

    def _edited(self, scene: Scene, text: str, problem: str | None) -> None:
        """Accept the text of an edited scene file after its scene is displayed. Until then no pose is written
        to the file, as its tables may have changed."""
        if problem is None and self._file is not None:
            with self._lock:
                self._file.text = text
            self.select_target(NO_TARGET)
            self._controls.offer_targets(self.target_names(scene))
            self._controls.update_from(scene, self.session.requested()[1])
        self._controls.show_status(problem or "")


def _silent() -> contextlib.AbstractContextManager[Any]:
    """Context that discards viser's messages on stdout, as commands print their own."""
    return contextlib.redirect_stdout(io.StringIO())


def _viser() -> Any:
    with required_package("viser", "viewer"):
        import viser
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # browsers may disconnect at any time
    return viser


def _viewpoint(camera: Any) -> Viewpoint:
    """The viewpoint of a browser's viser camera. Raises InputError for unusable numbers."""
    position, wxyz = np.asarray(camera.position, float), np.asarray(camera.wxyz, float)
    distance = float(np.linalg.norm(np.asarray(camera.look_at, float) - position))
    return Viewpoint(
        tuple(position.tolist()),
        tuple(wxyz.tolist()),
        float(camera.fov),
        max(1, camera.image_width),
        max(1, camera.image_height),
        max(distance, 1e-3),
    )


def _upright(pose: np.ndarray) -> np.ndarray:
    """Up direction of the page, about which the camera rotates: the world axis that points up in the image,
    if it is perpendicular to the image's rows, and else the camera's up direction."""
    up = -pose[:3, 1]
    axes = [axis for axis in (*np.eye(3), *-np.eye(3)) if abs(axis @ pose[:3, 0]) < 1e-6]
    best = max(axes, key=lambda axis: axis @ up, default=up)
    return best if best @ up > 0.1 else up


def _distance(scene: Scene, pose: np.ndarray) -> float:
    """Distance [m] from the camera to the page's centre of rotation: the nearest marker, or else the middle
    of the splats."""
    targets = [placed.pose[:3, 3] for placed in scene.markers]
    if not targets and isinstance(scene.splats, ChunkedSplats):
        targets = [sum(scene.splats.bounds()) / 2]
    elif not targets and len(cloud := scene.cloud()):
        targets = [np.median(cloud.means, axis=0) + cloud.origin]
    ahead = [float((target - pose[:3, 3]) @ pose[:3, 2]) for target in targets]
    return min((distance for distance in ahead if distance > 0), default=1.0)
