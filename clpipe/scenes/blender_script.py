"""Renders views of a Blender scene as linear EXRs. Blender's own Python runs it, without clpipe.

The last argument is a JSON file with the request; see :class:`clpipe.scenes.blender.Rendering`.
Each event is a line on standard output: :data:`MARK`, then JSON.
"""

import json
import os
import re
import sys
import time
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import bpy

# Blender does not add this directory.
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from blender_views import (
    GEOMETRY,
    SceneError,
    camera_of,
    face_camera,
    set_face,
    view_problem,
    views_of,
)

MARK = "@clpipe "
OLDEST = (4, 2)
SOURCE_LIBRARY = attrgetter("library")  # the other .blend that data was linked from
UNFINISHED = ".unfinished.exr"
TIMES = re.compile(rb"(cycles\.[^\0]*_time\0string\0.{4})([0-9:.]+)", re.DOTALL)


def send_event(event: str, **values: Any) -> None:
    """Print an event."""
    print(MARK + json.dumps({"event": event, **values}), flush=True)


def open_scene(path: str) -> Any:
    """Open a .blend file, and return its scene.

    Raises:
        SceneError: Blender is too old, the file cannot be read, or a file that it uses is
            missing.
    """
    if bpy.app.version < OLDEST:
        found = ".".join(map(str, bpy.app.version))
        oldest = ".".join(map(str, OLDEST))
        raise SceneError(f"this is Blender {found}, but {oldest} or newer is needed")
    try:
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
    except RuntimeError as error:
        raise SceneError(f"Blender cannot read this file: {str(error).strip()}") from None
    missing = [
        f"{kind} {each.name}: {file_of(each)}"
        for kind, files in (("texture", bpy.data.images), ("library", bpy.data.libraries))
        for each in files
        if is_missing(each)
    ]
    if missing:
        raise SceneError(
            f"a file that the scene uses is missing: {'; '.join(missing)}; pack it into the .blend"
        )
    return bpy.context.scene


def is_missing(data: Any) -> bool:
    """Return whether an image or library is used, but its file is missing."""
    if not data.filepath or data.packed_file or getattr(data, "source", "FILE") != "FILE":
        return False
    return data.users > 0 and not os.path.exists(file_of(data))


def file_of(data: Any) -> str:
    """Return the path of an image or library, resolved against the .blend that contains it."""
    return bpy.path.abspath(data.filepath, library=SOURCE_LIBRARY(data))


def prepare(scene: Any, request: Mapping[str, Any]) -> None:
    """Set up rendering: Cycles, its passes, and linear EXR with the same bytes each time.

    Raises:
        SceneError: this Blender was built without Cycles or its denoiser.
    """
    render, layer = scene.render, bpy.context.view_layer
    try:
        render.engine = "CYCLES"
    except TypeError:
        raise SceneError(
            "this Blender has no Cycles; use one from blender.org, or the package bpy"
        ) from None
    if request["resolution"]:
        render.resolution_x, render.resolution_y = request["resolution"]
        render.resolution_percentage = 100
    render.use_border = render.use_motion_blur = render.use_multiview = False
    render.use_compositing = render.use_sequencer = False
    render.use_persistent_data = True
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.time_limit = request["samples"], request["time_limit"] or 0
    cycles.use_denoising = request["denoise"]
    if request["denoise"]:
        try:
            cycles.denoiser = "OPENIMAGEDENOISE"
        except TypeError:
            raise SceneError("this Blender has no denoiser; add --no-denoise") from None
    cycles.seed, cycles.use_animated_seed = request["seed"], False
    for each in scene.view_layers:
        each.use = each == layer
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_object_index = True
    layer.use_pass_vector = True
    settings = render.image_settings
    if hasattr(settings, "media_type"):  # Blender 5.0 and later
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth, settings.exr_codec = "16", "ZIP"
    for name in dir(render):  # disable metadata: dates and times would differ each time
        if name.startswith("use_stamp"):
            setattr(render, name, False)


def index_objects(scene: Any) -> dict[int, list[str]]:
    """Return the names of objects by index. If the scene has no indices, assign them by name."""
    objects = sorted((o for o in scene.objects if o.type in GEOMETRY), key=lambda o: o.name)
    if not any(each.pass_index for each in objects):
        for number, each in enumerate(objects, 1):
            each.pass_index = number
    names: dict[int, list[str]] = {}
    for each in objects:
        names.setdefault(each.pass_index, []).append(each.name)
    return {number: names[number] for number in sorted(names) if number}


def render_view(scene: Any, folder: str, name: str, number: int, seed: int) -> None:
    """Render a view to NAME.exr, which is written as a whole or not at all.

    Raises:
        SceneError: it cannot be rendered or written.
    """
    unfinished = os.path.join(folder, f".{name}.{os.getpid()}{UNFINISHED}")
    settings = scene.render.image_settings
    if hasattr(settings, "use_exr_interleave"):
        # Blender 5.0 cannot write separate parts if pixels are not square.
        is_square = scene.render.pixel_aspect_x == scene.render.pixel_aspect_y
        settings.use_exr_interleave = not is_square
    scene.cycles.seed = (seed + number) % 2**31
    scene.render.filepath = unfinished
    try:
        bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        raise SceneError(f"view {name}: {' '.join(str(error).split())}") from None
    clear_render_times(unfinished)
    os.replace(unfinished, os.path.join(folder, f"{name}.exr"))


def clear_render_times(path: str) -> None:
    """Replace the render times in an EXR's header with zeros, for the same bytes each time."""
    with open(path, "r+b") as file:
        head = file.read(2**17)
        file.seek(0)
        file.write(TIMES.sub(lambda found: found[1] + re.sub(rb"[0-9]", b"0", found[2]), head))


def main(request: Mapping[str, Any]) -> None:
    """Render all views that do not exist yet."""
    scene = open_scene(request["scene"])
    if scene.camera is None:
        raise SceneError("this scene has no camera; add one, or pass cameras with --poses")
    prepare(scene, request)
    objects = index_objects(scene)
    views, notes = views_of(scene, request)
    cameras, obstructed = [], []
    for name, _, set_up_scene in views:
        set_up_scene()
        bpy.context.view_layer.update()
        cameras.append(camera_of(scene, name))
        if problem := view_problem(scene, cameras[-1]):
            obstructed.append(f"{name} ({problem})")
    if len(obstructed) == len(views):
        raise SceneError(
            f"every view sees too little: {', '.join(obstructed[:5])}; move the camera, or use "
            "--poses"
        )
    if obstructed:
        more = f" and {len(obstructed) - 5} others" if len(obstructed) > 5 else ""
        notes.append(f"these views see too little: {', '.join(obstructed[:5])}{more}")
    faces = request["faces"]
    if faces:  # a cube has no focal length
        cameras = [{k: record[k] for k in ("file", "R", "t")} for record in cameras]
    unit = scene.unit_settings
    send_event(
        "scene",
        blender=bpy.app.version_string,
        views=cameras,
        objects=objects,
        layers=["Depth", "Normal", "Object Index" if bpy.app.version >= (5, 0) else "IndexOB"],
        unit_metres=unit.scale_length if unit.system != "NONE" else None,
        notes=notes,
    )
    for name in os.listdir(request["folder"]):
        if name.endswith(UNFINISHED):  # left by a Blender that was killed
            os.remove(os.path.join(request["folder"], name))
    scene_camera, face = scene.camera, face_camera(scene) if faces else None
    for name, number, set_up_scene in views:
        start, rendered_count = time.perf_counter(), 0
        turns = faces["turns"] if faces else {"": None}
        for face_number, (face_name, rotation) in enumerate(turns.items()):
            file = f"{name}_{face_name}" if faces else name
            if os.path.exists(os.path.join(request["folder"], f"{file}.exr")):
                continue
            scene.camera = scene_camera
            set_up_scene()
            if faces:
                set_face(scene, face, rotation, faces["side"])
            render_view(
                scene, request["folder"], file, len(turns) * number + face_number, request["seed"]
            )
            rendered_count += 1
        send_event(
            "rendered", name=name, seconds=time.perf_counter() - start if rendered_count else 0.0
        )


if __name__ == "__main__":
    with open(sys.argv[-1], encoding="utf-8") as file:
        ASKED = json.load(file)
    try:
        main(ASKED)
    except SceneError as error:
        send_event("refused", message=str(error))
        sys.exit(1)
