"""Blender worker that renders plants from meshes, in Blender's Python without fidsplat.

    python blender_plants.py JOB.json

Prints "done FILE" for each image.
"""

import json
import math
import sys

import bpy  # type: ignore[import-not-found]
import numpy as np
from blender_worker import prepare, render  # type: ignore[import-not-found]


def main(job: dict) -> None:
    """Render all images of all plants on a transparent background."""
    scene = prepare(job)
    light(scene)
    render(scene, job["objects"], build)


def light(scene) -> None:
    """Set soft light from above, and a transparent background."""
    scene.cycles.max_bounces = 4
    scene.cycles.use_denoising = True
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True  # between images only the camera moves
    scene.render.image_settings.color_mode = "RGBA"
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = 3.0, math.radians(60)
    scene.collection.objects.link(bpy.data.objects.new("sun", sun))  # shines down


def build(one: dict):
    """Make a smooth mesh with vertex colours."""
    vertices, colors = np.array(one["vertices"]), np.array(one["colors"])
    mesh = bpy.data.meshes.new(one["name"])
    mesh.from_pydata(vertices.tolist(), [], one["quads"])
    mesh.shade_smooth()
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    painted = mesh.color_attributes.new("surface", "FLOAT_COLOR", "POINT")
    painted.data.foreach_set("color", np.column_stack([linear, np.ones(len(linear))]).ravel())
    mesh.materials.append(material())
    plant = bpy.data.objects.new(one["name"], mesh)
    bpy.context.scene.collection.objects.link(plant)
    return plant


def material():
    """Make a translucent material with the vertex colours."""
    leaf = bpy.data.materials.new("leaf")
    leaf.use_nodes = True
    tree = leaf.node_tree
    tree.nodes.clear()
    color = tree.nodes.new("ShaderNodeVertexColor")
    color.layer_name = "surface"
    output, mixed = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeMixShader")
    mixed.inputs[0].default_value = 0.3
    for place, kind in ((1, "ShaderNodeBsdfDiffuse"), (2, "ShaderNodeBsdfTranslucent")):
        shader = tree.nodes.new(kind)
        tree.links.new(color.outputs["Color"], shader.inputs["Color"])
        tree.links.new(shader.outputs[0], mixed.inputs[place])
    tree.links.new(mixed.outputs[0], output.inputs["Surface"])
    return leaf


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        main(json.load(stream))
