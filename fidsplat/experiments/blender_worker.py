"""Blender worker that renders the textured planes of a job, in Blender's Python without fidsplat.

    python blender_worker.py JOB.json

Prints "done FILE" for each image.
"""

import json
import os
import sys

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Matrix  # type: ignore[import-not-found]


def main(job: dict) -> None:
    """Render all images of all markers."""
    scene = prepare(job)
    render(scene, job["objects"], lambda marker: build(marker, job["view"]))


def render(scene, objects: list[dict], build) -> None:
    """Build each object and render its images into their files."""
    for item in objects:
        built = build(item)
        for image in item["images"]:
            aim(scene, image)
            # the worker of a killed run may still write the same image
            part = f"{image['file']}.{os.getpid()}.part.png"
            scene.render.filepath = part
            bpy.ops.render.render(write_still=True)
            os.replace(part, image["file"])
            print("done", image["file"], flush=True)
        bpy.data.objects.remove(built, do_unlink=True)


def prepare(job: dict):
    """Make an empty scene: Cycles on the CPU, without bounces, denoising and dithering."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = job["samples"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = 0
    cycles.seed = 0
    cycles.pixel_filter_type = job["filter"]
    if job["filter"] != "BOX":
        cycles.filter_width = 1.5
    render = scene.render
    render.threads_mode, render.threads = "FIXED", job["threads"]
    render.dither_intensity = 0.0  # the default dithers level 123 to a mixture of 123 and 124
    render.image_settings.file_format = "PNG"
    render.image_settings.color_mode = "RGB"
    render.image_settings.color_depth = "8"
    render.resolution_percentage = 100
    # the default view transform, AgX, displays white as 196
    scene.view_settings.view_transform = "Standard" if job["view"] == "standard" else "Raw"
    scene.view_settings.look = "None"
    ground = job["background"]
    if job["view"] == "standard":
        ground = ground / 12.92 if ground <= 0.04045 else ((ground + 0.055) / 1.055) ** 2.4
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (ground, ground, ground, 1)
    scene.world = world
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.sensor_fit = "HORIZONTAL"
    camera.data.clip_start = 0.01
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def build(marker: dict, view: str):
    """Make a textured plane z = 0, x right, y down, with one texture pixel per module."""
    grid = np.array(marker["grid"])
    rows, columns = grid.shape
    x, y = columns * marker["module"] / 2, rows * marker["module"] / 2
    mesh = bpy.data.meshes.new(marker["name"])
    mesh.from_pydata([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [], [(0, 1, 2, 3)])
    corners = mesh.uv_layers.new().data
    for corner, uv in zip(corners, [(0, 1), (1, 1), (1, 0), (0, 0)], strict=True):
        corner.uv = uv
    bitmap = bpy.data.images.new(marker["name"], columns, rows)
    bitmap.colorspace_settings.name = "sRGB" if view == "standard" else "Non-Color"
    pixels = np.ones((rows, columns, 4), np.float32)
    pixels[:, :, :3] = 1 - grid[::-1, :, None]  # Blender's first row is at the bottom
    bitmap.pixels.foreach_set(pixels.ravel())
    bitmap.update()
    material = bpy.data.materials.new(marker["name"])
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = bitmap, "Closest", "EXTEND"
    emission = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    mesh.materials.append(material)
    plane = bpy.data.objects.new(marker["name"], mesh)
    bpy.context.scene.collection.objects.link(plane)
    return plane


def aim(scene, image: dict) -> None:
    """Set the camera. Blender's camera looks along -z with y up, fidsplat's along z with y down."""
    width, height = image["width"], image["height"]
    scene.render.resolution_x, scene.render.resolution_y = width, height
    data = scene.camera.data
    data.lens = image["fx"] / width * data.sensor_width
    data.shift_x = (width / 2 - image["cx"]) / width
    data.shift_y = (image["cy"] - height / 2) / width
    pose = np.linalg.inv(np.array(image["matrix"])) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene.camera.matrix_world = Matrix(pose.tolist())


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        main(json.load(stream))
