"""Render what ``test_defocus.py`` holds clpipe's depth of field against, with Blender's Cycles.

In a Python 3.11 venv (pip install bpy==5.0.1 openexr):

    python tests/data/defocus/make.py

Two bars stand before a wall that is in focus, beside which another is farther away. Everything
shines by itself, so that all noise is the lens's. It writes pinhole.exr, which has depth, and
thin_lens.exr here.
"""

import sys
from pathlib import Path

import bpy
import numpy as np
import OpenEXR

WIDTH, HEIGHT, SAMPLES = 240, 160, 1024
FOCAL_LENGTH, SENSOR_WIDTH, F_NUMBER, FOCUS = 50.0, 36.0, 0.5, 3.0


def plane(name, centre, size, colours, scale):
    """A shining plane that faces the camera, which looks along +y."""
    bpy.ops.mesh.primitive_plane_add(size=1, location=centre, rotation=(np.pi / 2, 0, 0))
    thing = bpy.context.object
    thing.name, thing.scale = name, (*size, 1)
    paint = bpy.data.materials.new(name)
    paint.use_nodes = True
    nodes, links = paint.node_tree.nodes, paint.node_tree.links
    nodes.clear()
    places, noise = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = scale, 1.0
    ramp, shine = nodes.new("ShaderNodeValToRGB"), nodes.new("ShaderNodeEmission")
    for stop, at, colour in zip(ramp.color_ramp.elements, (0.35, 0.65), colours, strict=True):
        stop.position, stop.color = at, (*colour, 1)
    out = nodes.new("ShaderNodeOutputMaterial")
    links.new(places.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shine.inputs["Color"])
    links.new(shine.outputs["Emission"], out.inputs["Surface"])
    thing.data.materials.append(paint)


def scene():
    """The walls, the bars and the camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    plane("far wall", (0, 6, 0), (9, 6), ((0.1, 0.2, 0.7), (0.3, 0.8, 0.9)), 6)
    plane("wall", (-1.2, 3, 0), (3, 4), ((0.2, 0.5, 0.2), (0.8, 0.9, 0.5)), 12)
    plane("bar", (-0.1, 1.3, 0), (0.16, 2), ((0.9, 0.2, 0.1), (1.2, 0.5, 0.2)), 8)
    plane("near bar", (0.1, 1.1, -0.12), (0.5, 0.06), ((0.5, 0.1, 0.5), (0.9, 0.4, 0.9)), 8)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.rotation_euler = (np.pi / 2, 0, 0)
    bpy.context.collection.objects.link(camera)
    here = bpy.context.scene
    here.camera, data = camera, camera.data
    data.lens, data.sensor_width, data.sensor_fit = FOCAL_LENGTH, SENSOR_WIDTH, "HORIZONTAL"
    data.dof.focus_distance, data.dof.aperture_fstop = FOCUS, F_NUMBER
    here.render.engine = "CYCLES"
    here.cycles.samples, here.cycles.use_denoising = SAMPLES, False
    here.cycles.use_adaptive_sampling = False
    here.render.resolution_x, here.render.resolution_y = WIDTH, HEIGHT
    here.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    here.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    here.render.image_settings.color_depth = "32"
    here.view_layers[0].use_pass_z = True
    return here


def render(here, has_lens, folder):
    """The channels of a render, with or without depth of field."""
    here.camera.data.dof.use_dof = has_lens
    path = folder / "render.exr"
    here.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    channels = {name: c for part in parts for name, c in part.channels.items()}
    path.unlink()
    found = {
        name.rsplit(".", 1)[-1]: c.pixels for name, c in channels.items() if "Combined" in name
    }
    (depth,) = (c.pixels for name, c in channels.items() if "Depth" in name)
    return {name: found[name].astype(np.float16) for name in "RGB"}, depth


def write(path, channels):
    """Write an EXR."""
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(kind, channels).write(str(path))


if __name__ == "__main__":
    folder, here = Path(__file__).parent, scene()
    colours, depth = render(here, False, folder)
    write(folder / "pinhole.exr", {**colours, "Z": depth.astype(np.float16)})
    write(folder / "thin_lens.exr", render(here, True, folder)[0])
    sys.exit()
