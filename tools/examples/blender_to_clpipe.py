"""Render the frames of a Blender scene with Cycles, half EXR, and put them through clpipe.

    blender -b scene.blend -P tools/examples/blender_to_clpipe.py -- frames out --iso 3200

or, without Blender, in a Python 3.11 venv of its own (pip install bpy==5.0.1):

    python tools/examples/blender_to_clpipe.py -- frames out --iso 3200

FRAMES and OUT are folders; what follows goes to clpipe run. clpipe is another Python's: it is taken
from the PATH, or is what $CLPIPE names. Without a scene a turning monkey is rendered.

A frame that is there is neither rendered nor developed again, so after a crash the same command
goes on. Blender may have left its last frame half written then: clpipe calls it damaged; remove it.
"""

import os
import subprocess
import sys
from pathlib import Path

import bpy


def turning_monkey() -> None:
    """A small scene of its own: 4 frames, seen by a camera in soft light."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_end = 4
    bpy.ops.mesh.primitive_monkey_add()
    monkey = bpy.context.object
    for frame in (1, scene.frame_end):
        monkey.rotation_euler.z = 0.2 * frame
        monkey.keyframe_insert("rotation_euler", frame=frame)
    bpy.ops.object.camera_add(location=(0, -5, 0.6), rotation=(1.45, 0, 0))
    scene.camera = bpy.context.object
    bpy.ops.object.light_add(type="AREA", radius=3, location=(-3, -4, 4), rotation=(0.8, 0, -0.6))
    bpy.context.object.data.energy = 250
    scene.render.resolution_x = scene.render.resolution_y = 96
    scene.cycles.samples = 16


def render(folder: Path) -> None:
    """Render the scene's frames to FOLDER/0001.exr and so on."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    # The renderer's own noise is no camera's: denoise, or take many samples.
    scene.cycles.use_denoising = True
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "16"
    # EXR is scene linear whatever the view transform. 1.0 is the sensor's full scale: expose for
    # it here, or with --set exposure.ev.
    scene.render.use_overwrite = False
    scene.render.filepath = f"{folder.resolve()}/####"
    bpy.ops.render.render(animation=True)


def main() -> int:
    """Render, then develop; clpipe's exit status."""
    frames, output, *options = sys.argv[sys.argv.index("--") + 1 :]
    if not bpy.data.filepath:
        turning_monkey()
    render(Path(frames))
    clpipe = os.environ.get("CLPIPE", "clpipe")
    return subprocess.run([clpipe, "run", frames, "-o", output, *options], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
