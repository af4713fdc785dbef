"""Make a small scene for clpipe dataset: a room with two walls, glass, metal and two lamps.

    blender -b -P tools/examples/room_scene.py -- room.blend

or, without Blender, in a Python 3.11 venv (pip install bpy==5.0.1):

    python tools/examples/room_scene.py room.blend

The scene is built only from code, with meshes and procedural materials. One unit is a metre; z
points up.
"""

import argparse
import sys
from math import radians

WHITE, WARM, COLD = (0.8, 0.8, 0.8, 1), (1, 0.75, 0.5, 1), (0.6, 0.8, 1, 1)


def material(name, colour=WHITE, texture=None, scale=1.0, **inputs):
    """Return a Principled material; `texture` is the name of a texture node, such as "Brick"."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    shader = tree.nodes["Principled BSDF"]
    values = {"Base Color": colour, "Roughness": 0.8, **inputs}
    for socket, value in values.items():
        shader.inputs[socket].default_value = value
    if texture:
        paint = tree.nodes.new(f"ShaderNodeTex{texture}")
        paint.inputs["Scale"].default_value = scale
        places = tree.nodes.new("ShaderNodeTexCoord")
        tree.links.new(places.outputs["UV"], paint.inputs["Vector"])
        tree.links.new(paint.outputs["Color"], shader.inputs["Base Color"])
    return made


def add(kind, name, paint, location, **options):
    """Add one of Blender's primitive meshes, such as "cube"."""
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(location=location, **options)
    thing = bpy.context.object
    thing.name = name
    thing.data.materials.append(paint)
    return thing


def lamp(name, colour, power, location, size):
    """Add an area lamp that points at the middle of the room."""
    data = bpy.data.lights.new(name, "AREA")
    data.energy, data.color, data.size = power, colour[:3], size
    thing = bpy.data.objects.new(name, data)
    thing.location = location
    thing.rotation_euler = (-Vector(location)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.collection.objects.link(thing)


def room():
    """Build the scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    white = material("white wall")
    bricks = material("bricks", texture="Brick", scale=6)
    checks = material("checks", texture="Checker", scale=16)
    clouds = material("clouds", texture="Noise", scale=9)
    glass = material("glass", **{"Transmission Weight": 1.0, "Roughness": 0.0, "IOR": 1.45})
    metal = material("metal", (0.9, 0.7, 0.4, 1), **{"Metallic": 1.0, "Roughness": 0.2})
    add("plane", "floor", checks, (0, 0, 0), size=6)
    add("plane", "brick wall", bricks, (0, 2, 2), size=6, rotation=(radians(90), 0, 0))
    add("plane", "white wall", white, (-2.5, 0, 2), size=6, rotation=(0, radians(90), 0))
    ball = add("uv_sphere", "glass ball", glass, (-0.7, -0.3, 0.5), radius=0.5)
    head = add("monkey", "head", clouds, (0.6, 0.3, 0.6), size=1.1, rotation=(-0.5, 0, 0.5))
    ring = add("torus", "ring", metal, (0, -1, 0.12), major_radius=0.35, minor_radius=0.12)
    add("cube", "box", bricks, (1.5, -0.6, 0.3), size=0.6, rotation=(0, 0, 0.4))
    for thing in (ball, head, ring):
        thing.data.shade_smooth()
    lamp("warm lamp", WARM, 120, (2, -2, 3), 0.8)
    lamp("cold lamp", COLD, 40, (-2, -2.5, 2.5), 1.5)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (1.2, -4.6, 1.7)
    ahead = Vector((0, 0, 0.7)) - camera.location
    camera.rotation_euler = ahead.to_track_quat("-Z", "Y").to_euler()
    bpy.context.collection.objects.link(camera)
    scene = bpy.context.scene
    scene.camera = camera
    scene.frame_end = 4
    for frame in (1, 4):
        head.rotation_euler.z = 0.5 + 0.1 * frame
        head.keyframe_insert("rotation_euler", frame=frame)
    scene.world = bpy.data.worlds.new("dusk")
    scene.render.resolution_x, scene.render.resolution_y = 960, 640


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make a small scene for clpipe dataset.")
    parser.add_argument("file", metavar="FILE.blend", help="the file to write")
    # Blender's own options are before "--".
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    path = parser.parse_args(words).file

    import bpy
    from mathutils import Vector

    room()
    bpy.ops.wm.save_as_mainfile(filepath=path)
