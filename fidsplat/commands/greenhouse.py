"""Command `fidsplat greenhouse`: make a greenhouse of splats."""

from dataclasses import dataclass, field

from fidsplat.commands.options import Json, Overwrite
from fidsplat.commands.output import report
from fidsplat.util.files import path_of, refuse_existing, writable_folder, write_file
from fidsplat.worlds.greenhouse import Greenhouse as World
from fidsplat.worlds.greenhouse import GreenhouseSettings


@dataclass
class Greenhouse:
    """Make a greenhouse of splats: plants on benches under glass, with AprilTags and QR codes.

    DIR/greenhouse.toml is a scene for every command, next to its splat files. DIR/greenhouse.xml is a MuJoCo
    model for collisions of a robot. Tomatoes, cucumbers and lettuces are grown from the seed or read from a
    folder of plants. Tags of 0.16 m are on the sides and ends of the benches, a QR code is above each row.

    Examples:
      fidsplat greenhouse
      fidsplat greenhouse -o small --rows 2 --plants 6 --seed 3
      fidsplat greenhouse -o real --plants-from plants   plants of fidsplat experiment plants
      fidsplat render greenhouse/greenhouse.toml
    """

    out: str = "greenhouse"
    """DIR: folder"""
    layout: GreenhouseSettings = field(default_factory=GreenhouseSettings)
    plants_from: str | None = None
    """DIR: folder of plants KIND-NUMBER.ply (default: plants are grown as disks)"""
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.worlds.plants import load_plants

        stock = None if self.plants_from is None else load_plants(self.plants_from)
        settings = self.layout
        world = World(**vars(settings), stock=stock)
        folder = path_of(self.out)
        scene_file, model = folder / "greenhouse.toml", folder / "greenhouse.xml"
        refuse_existing(scene_file, self.overwrite)
        scene = world.scene
        writable_folder(folder)
        write_file(model, world.mjcf())
        scene.save(scene_file)  # written last, since the scene file marks a complete greenhouse
        plants, splats, markers = settings.rows * settings.plants, len(scene.cloud()), len(world.markers)
        facts = {"scene": str(scene_file), "model": str(model), "splats": splats, "markers": markers}
        facts |= {"rows": settings.rows, "plants": plants, "length_m": world.length}
        words = f"{plants} plants in {settings.rows} rows, {splats} splats, {markers} markers"
        return report(self.json, facts, words, f"render it: fidsplat render {scene_file}")
