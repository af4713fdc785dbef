"""Make the scene of the experiment: surfaces with strong, weak and no texture, evenly lit.

    python tools/reconstruction/scene.py FOLDER

It needs Blender's package bpy, or Blender itself:

    blender -b -P tools/reconstruction/scene.py -- FOLDER

It writes the same scene to FOLDER/colour.blend and FOLDER/centres.blend. The first is antialiased.
In the second, each pixel is the ray through its centre, for depth and object numbers.

The scene is built only from code, with meshes and procedural materials. One unit is a metre. x
points right, y away from the cameras, and z up. An object's number is that of its texture.
"""

import argparse
import sys
from math import radians
from pathlib import Path

# The contrast of each texture's noise around the mean.
STRONG, WEAK, NONE = 1, 2, 3
CONTRAST = {STRONG: 0.85, WEAK: 0.12, NONE: 0.0}
WALL = 1.2  # y
RAY = 0.01  # px, filter width at which a pixel is one ray

STONE, CLAY, MOSS, SAND = (0.42, 0.38, 0.34), (0.5, 0.3, 0.2), (0.3, 0.4, 0.25), (0.5, 0.46, 0.38)
PAPER = (0.7, 0.7, 0.7)


def material(number, colour, scale):
    """Return a matte material: fractal noise around a colour, with the contrast of a texture."""
    made = bpy.data.materials.new(f"texture {number}")
    made.use_nodes = True
    tree = made.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = 1.0
    shader.inputs["Specular IOR Level"].default_value = 0.0
    places = tree.nodes.new("ShaderNodeTexCoord")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    for name, value in {"Scale": scale, "Detail": 5.0, "Roughness": 0.8}.items():
        noise.inputs[name].default_value = value
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    sides = zip(ramp.color_ramp.elements, (0.3, 0.7), (-1, 1), strict=True)
    for element, position, side in sides:  # little of the noise is outside 0.3 to 0.7
        element.position = position
        element.color = (*(c * (1 + side * CONTRAST[number]) for c in colour), 1)
    tree.links.new(places.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return made


def add(kind, number, colour, scale, location, size, turn=(0, 0, 0)):
    """Add one of Blender's primitive meshes with a texture; sizes in m, rotations in degrees."""
    options = {"subdivisions": 6} if kind == "ico_sphere" else {}
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(
        location=location, rotation=[radians(angle) for angle in turn], **options
    )
    thing = bpy.context.object
    thing.scale = [side / 2 for side in size]
    bpy.ops.object.transform_apply(location=False, rotation=False)
    thing.pass_index = number
    thing.data.materials.append(material(number, colour, scale))
    return thing


def rough(thing, depth, size):
    """Displace a mesh by dents of a depth and a size, in m."""
    dents = thing.modifiers.new("dents", "DISPLACE")
    dents.texture = bpy.data.textures.new("dents", "CLOUDS")
    dents.texture.noise_scale, dents.strength = size, depth
    thing.data.shade_smooth()


def build():
    """Build the scene: a wall in three parts, a floor, and objects with the three textures."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add("plane", STRONG, SAND, 22, (0, -1, 0), (12, 6, 0))
    add("plane", STRONG, STONE, 20, (-3.55, WALL, 2), (5.5, 8, 0), (90, 0, 0))
    add("plane", WEAK, STONE, 24, (0.05, WALL, 2), (1.7, 8, 0), (90, 0, 0))
    add("plane", NONE, PAPER, 1, (3.65, WALL, 2), (5.5, 8, 0), (90, 0, 0))
    rough(add("ico_sphere", STRONG, MOSS, 30, (-1.1, 0.1, 0.45), (0.9, 0.9, 0.9)), 0.2, 0.3)
    add("cube", STRONG, CLAY, 25, (-0.45, 0.55, 0.5), (0.45, 0.45, 1.0), (0, 0, 30))
    rough(add("ico_sphere", WEAK, CLAY, 22, (0.1, -0.1, 0.35), (0.7, 0.7, 0.7)), 0.12, 0.3)
    add("cube", WEAK, MOSS, 20, (0.45, 0.6, 0.65), (0.4, 0.4, 1.3), (0, 0, -25))
    add("cube", NONE, PAPER, 1, (1.2, 0.25, 0.35), (0.6, 0.6, 0.7), (0, 0, 35))
    lamp = bpy.data.lights.new("lamp", "AREA")
    lamp.energy, lamp.size = 50, 3.0
    shining = bpy.data.objects.new("lamp", lamp)
    shining.location, shining.rotation_euler = (-1.5, -3.5, 4), (radians(45), 0, radians(-20))
    sky = bpy.data.worlds.new("sky")
    sky.use_nodes = True
    sky.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    sky.node_tree.nodes["Background"].inputs[1].default_value = 0.475
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    for thing in (shining, camera):
        bpy.context.collection.objects.link(thing)
    scene = bpy.context.scene
    scene.world, scene.camera = sky, camera
    scene.cycles.max_bounces = 2
    scene.cycles.pixel_filter_type = "GAUSSIAN"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the scene of the experiment in Blender.")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="for the .blend files")
    # Blender's own options are before "--".
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    folder = parser.parse_args(words).folder.resolve()

    import bpy

    build()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "colour.blend"))
    bpy.context.scene.cycles.filter_width = RAY
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "centres.blend"))
