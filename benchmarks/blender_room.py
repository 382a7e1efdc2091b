"""Blender worker that renders lit markers in a room of glowing panels, and diffuse meshes, in Blender's
Python without fidsplat.

    python blender_room.py JOB.json

Panels radiate and do not reflect. Writes linear RGB of each image as a NumPy file and prints "done FILE".
"""

import json
import math
import os
import sys

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Vector  # type: ignore[import-not-found]

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "..", "fidsplat", "experiments"))
from blender_worker import aim, prepare  # type: ignore[import-not-found]


def main(job: dict) -> None:
    """Render all images of all scenes."""
    for one in job["objects"]:
        scene = prepare({**job, "view": "raw", "filter": "BOX", "background": 0.0})
        bounces = one.get("bounces", 1)
        scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = bounces
        scene.cycles.use_denoising = job["denoise"]
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.image_settings.color_depth = "32"
        scene.render.use_persistent_data = True
        for number, panel in enumerate(one["panels"]):
            add(f"panel {number}", panel["corners"], [(0, 1, 2, 3)], emission(panel["radiance"]))
        for light in one["lights"]:
            add_light(light)
        if "mesh" in one:
            diffuse_mesh(one["mesh"])
            scene.cycles.denoising_prefilter = scene.cycles.denoising_quality = "FAST"
        for each in one.get("sheets", [one]):
            sheet(each)
        for image in one["images"]:
            aim(scene, image)
            part = f"{image['file']}.{os.getpid()}.exr"
            scene.render.filepath = part
            bpy.ops.render.render(write_still=True)
            made = bpy.data.images.load(part)
            made.colorspace_settings.name = "Non-Color"
            pixels = np.empty(image["width"] * image["height"] * 4, np.float32)
            made.pixels.foreach_get(pixels)
            bpy.data.images.remove(made)
            os.remove(part)
            rows = pixels.reshape(image["height"], image["width"], 4)[::-1, :, :3]
            with open(f"{image['file']}.{os.getpid()}.part", "wb") as stream:
                np.save(stream, np.ascontiguousarray(rows))
            os.replace(stream.name, image["file"])
            print("done", image["file"], flush=True)


def add(name: str, vertices: list, faces: list, material):
    """Add a mesh."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(vertex) for vertex in vertices], [], faces)
    mesh.materials.append(material)
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return mesh


def nodes(name: str):
    """Make a material with only an output node."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes.clear()
    return made, made.node_tree, made.node_tree.nodes.new("ShaderNodeOutputMaterial")


def emission(radiance: list):
    """Make a material that radiates and does not reflect."""
    made, tree, output = nodes("emission")
    shader = tree.nodes.new("ShaderNodeEmission")
    shader.inputs["Color"].default_value = (*radiance, 1.0)
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    return made


def diffuse_mesh(given: dict) -> None:
    """Add a diffuse mesh with an albedo per face."""
    made, tree, output = nodes("diffuse")
    albedo = tree.nodes.new("ShaderNodeAttribute")
    albedo.attribute_name = "albedo"
    shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
    tree.links.new(albedo.outputs["Color"], shader.inputs["Color"])
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    mesh = add("mesh", given["vertices"], given["faces"], made)
    colors = np.pad(np.array(given["albedo"], np.float32), ((0, 0), (0, 1)), constant_values=1)
    mesh.attributes.new("albedo", "FLOAT_COLOR", "FACE").data.foreach_set("color", colors.ravel())


def add_light(light: dict) -> None:
    """Add a sun (energy: irradiance) or a point light (energy: radiant intensity times 4 pi)."""
    data = bpy.data.lights.new(light["kind"], "SUN" if light["kind"] == "sun" else "POINT")
    made = bpy.data.objects.new(light["kind"], data)
    if light["kind"] == "sun":
        data.energy, data.angle = light["intensity"], light["angle"]
        made.rotation_mode = "QUATERNION"
        made.rotation_quaternion = Vector(light["direction"]).to_track_quat("-Z", "Y")
    else:
        data.energy, data.shadow_soft_size = 4 * math.pi * light["intensity"], light["radius"]
        made.location = light["position"]
    bpy.context.scene.collection.objects.link(made)


def sheet(one: dict) -> None:
    """Add a marker as the mesh of its sheet, with a texture of one pixel per module."""
    points, grid = np.array(one["points"]), np.array(one["grid"])
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1).reshape(-1, 4)
    bitmap = bpy.data.images.new("code", grid.shape[1], grid.shape[0], float_buffer=True)
    bitmap.colorspace_settings.name = "Non-Color"
    pixels = np.ones((*grid.shape, 4), np.float32)
    pixels[:, :, :3] = np.where(grid[::-1, :, None] > 0, one["ink"], one["paper"])
    bitmap.pixels.foreach_set(pixels.ravel())
    bitmap.update()
    made, tree, output = nodes("sheet")
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = bitmap, "Closest", "EXTEND"
    if one["emits"]:
        shader = tree.nodes.new("ShaderNodeEmission")
        tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
    elif one["roughness"] is None:
        shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
        tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
    else:
        shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
        shader.distribution = "GGX"
        tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
        shader.inputs["Roughness"].default_value = one["roughness"]
        shader.inputs["IOR"].default_value = 1.5
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    mesh = add("sheet", points.reshape(-1, 3), quads.tolist(), made)
    v, u = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    coordinates = np.stack([u, 1 - v], -1).reshape(-1, 2)[quads.ravel()]
    mesh.uv_layers.new().data.foreach_set("uv", coordinates.ravel())
    if one["smooth"]:
        mesh.shade_smooth()


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream_of_job:
        main(json.load(stream_of_job))
