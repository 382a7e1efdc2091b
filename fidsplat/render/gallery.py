"""Gallery: an HTML page of rendered scenes with their scene files."""

from __future__ import annotations

import html
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from fidsplat import __version__
from fidsplat.images.files import write_png
from fidsplat.render.output_files import visualisation_of
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.util.files import atomic_write, printable, read_text, writable_folder
from fidsplat.util.provenance import digest_of

PAGE = "index.html"
_POLICY = "script-src 'none'; object-src 'none'; frame-src 'none'; base-uri 'none'; form-action 'none'"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem;
       background: #fff; color: #222 }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(22rem, 1fr)); gap: 2rem }
img { max-width: 100%; border-radius: 4px } .more img { width: 48% }
pre { overflow: auto; font-size: 12px; background: #8881; padding: 0.5rem }
p { color: #777; margin: 0.3rem 0 }
@media (prefers-color-scheme: dark) { body { background: #16181c; color: #ddd } }
"""


@dataclass(frozen=True, eq=False)
class GalleryScene:
    """A scene of a gallery, with its title and its scene file."""

    name: str
    """stem of its image files"""
    title: str
    scene: Scene
    text: str = field(default="", repr=False)
    """text of the scene file; empty for splat files"""


def gallery_scene(source: Path, scene: Scene) -> GalleryScene:
    """A scene with the text of its file. The title is the comment on the first line, without a command that
    follows it, as in `# Fog. fidsplat render fog.toml`."""
    text = read_text(source, "replace") if source.suffix.lower() == ".toml" else ""
    first = text.partition("\n")[0]
    title = first.lstrip("# ").partition(". fidsplat")[0] if first.startswith("#") else source.stem
    return GalleryScene(source.stem, title.rstrip("."), scene, text)


def write_gallery(folder: Path, scenes: Sequence[GalleryScene], device: str | None = None) -> Iterator[Path]:
    """Render scenes into a folder and write index.html. Unchanged scenes are not rendered again.

    Yields the image of the first output of each scene when all of its images exist, then index.html.

    Args:
        device: replaces the devices of the scenes.

    Raises:
        InputError: the folder cannot be written, or a scene has no camera.
        DeviceError: a device fails.
    """
    writable_folder(folder)
    renderers: dict[str | None, Renderer] = {}
    figures = []
    for entry in scenes:
        device_name = device or entry.scene.device
        if device_name not in renderers:
            renderers[device_name] = Renderer(device_name)
        renderer = renderers[device_name]
        key = digest_of((entry.scene.content, entry.scene.capture, renderer.device.title, __version__))
        files = [folder / f"{entry.name[:60]}-{name}-{key}.png" for name in entry.scene.capture.outputs]
        if not all(file.exists() for file in files):
            frame = renderer.render(entry.scene)
            for name, file in zip(frame.outputs, files, strict=True):
                write_png(file, visualisation_of(name, frame[name]))
        figures.append(_figure(entry, files, renderer.device.title))
        yield files[0]
    with atomic_write(folder / PAGE) as stream:
        stream.write(printable(_page(figures)).encode())
    yield folder / PAGE


def _figure(entry: GalleryScene, files: Sequence[Path], device: str) -> str:
    escape = html.escape
    first, *more = [quote(os.fsencode(file.name)) for file in files]
    markers = ", ".join(placed.marker.spec for placed in entry.scene.markers)
    facts = f"{len(entry.scene.splats):,} splats{': ' if markers else ''}{markers[:200]}. {device}"
    images = "".join(f'<a href="{name}"><img src="{name}" loading="lazy" alt=""></a> ' for name in more)
    text = f"<details><summary>scene file</summary><pre>{escape(entry.text)}</pre></details>"
    return (
        f'<figure style="margin:0"><a href="{first}"><img src="{first}" alt="{escape(entry.title)}"></a>'
        f"<figcaption>{escape(entry.title)}<p>{escape(facts)}</p></figcaption>"
        f'<div class="more">{images}</div>{text if entry.text else ""}</figure>'
    )


def _page(figures: Sequence[str]) -> str:
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>fidsplat</title>'
        '<meta name="viewport" content="width=device-width">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f"<style>{_STYLE}</style><h1>fidsplat</h1><main>{''.join(figures)}</main></html>\n"
    )
