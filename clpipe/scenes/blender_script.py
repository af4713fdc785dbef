"""Renders views of a Blender scene as linear EXRs. Blender's own Python runs it, without clpipe.

What is asked is a JSON file, the last argument; see :class:`clpipe.scenes.blender.Rendering`. What
happens goes to standard output, a line of JSON behind :data:`MARK` for each event.
"""

import json
import math
import os
import random
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from operator import attrgetter
from typing import Any

import bpy
from mathutils import Matrix, Vector

MARK = "@clpipe "
OLDEST = (4, 2)
FLIP = Matrix(((1, 0, 0), (0, -1, 0), (0, 0, -1)))  # from Blender's camera axes to OpenCV's
OWNER = attrgetter("library")  # of what comes from another .blend
UNFINISHED = ".unfinished.exr"
GEOMETRY = {"MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD"}
SPAN = math.radians(60)  # of an arc
TIMES = re.compile(rb"(cycles\.[^\0]*_time\0string\0.{4})([0-9:.]+)", re.DOTALL)


class RefusedError(Exception):
    """Something that the user can mend."""


def tell(event: str, **values: Any) -> None:
    """Say what happened."""
    print(MARK + json.dumps({"event": event, **values}), flush=True)


def open_scene(path: str) -> Any:
    """The scene of a .blend file, with all that it needs.

    Raises:
        RefusedError: Blender is too old, or the file cannot be read or lacks a file.
    """
    if bpy.app.version < OLDEST:
        found = ".".join(map(str, bpy.app.version))
        raise RefusedError(f"found Blender {found}; expected {'.'.join(map(str, OLDEST))} or newer")
    try:
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
    except RuntimeError as error:
        raise RefusedError(f"Blender cannot read it: {str(error).strip()}") from None
    missing = [
        f"{kind} {each.name}: {file_of(each)}"
        for kind, files in (("texture", bpy.data.images), ("library", bpy.data.libraries))
        for each in files
        if is_missing(each)
    ]
    if missing:
        raise RefusedError(f"a file is missing: {'; '.join(missing)}; pack it into the .blend")
    return bpy.context.scene


def is_missing(data: Any) -> bool:
    """Whether an image or a library is used, and its file is not there."""
    if not data.filepath or data.packed_file or getattr(data, "source", "FILE") != "FILE":
        return False
    return data.users > 0 and not os.path.exists(file_of(data))


def file_of(data: Any) -> str:
    """The path of an image or a library; a relative one counts from the .blend that says it."""
    return bpy.path.abspath(data.filepath, library=OWNER(data))


def prepare(scene: Any, asked: Mapping[str, Any]) -> None:
    """Set up rendering: Cycles, its passes, linear EXR, the same bytes each time.

    Raises:
        RefusedError: this Blender was built without Cycles or its denoiser.
    """
    render, layer = scene.render, bpy.context.view_layer
    try:
        render.engine = "CYCLES"
    except TypeError:
        raise RefusedError("this Blender has no Cycles; use one from blender.org, or bpy") from None
    if asked["resolution"]:
        render.resolution_x, render.resolution_y = asked["resolution"]
        render.resolution_percentage = 100
    render.use_border = render.use_motion_blur = render.use_multiview = False
    render.use_compositing = render.use_sequencer = False
    render.use_persistent_data = True
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.time_limit = asked["samples"], asked["time_limit"] or 0
    cycles.use_denoising = asked["denoise"]
    if asked["denoise"]:
        try:
            cycles.denoiser = "OPENIMAGEDENOISE"
        except TypeError:
            raise RefusedError("this Blender has no denoiser; say --no-denoise") from None
    cycles.seed, cycles.use_animated_seed = asked["seed"], False
    for each in scene.view_layers:
        each.use = each == layer
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_object_index = True
    layer.use_pass_vector = True
    settings = render.image_settings
    if hasattr(settings, "media_type"):  # from Blender 5.0 on
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth, settings.exr_codec = "16", "ZIP"
    for name in dir(render):  # dates and times would differ each time
        if name.startswith("use_stamp"):
            setattr(render, name, False)


def number_objects(scene: Any) -> dict[int, list[str]]:
    """The names of objects by their numbers, which are given where the scene gives none."""
    objects = sorted((o for o in scene.objects if o.type in GEOMETRY), key=lambda o: o.name)
    if not any(each.pass_index for each in objects):
        for number, each in enumerate(objects, 1):
            each.pass_index = number
    names: dict[int, list[str]] = {}
    for each in objects:
        names.setdefault(each.pass_index, []).append(each.name)
    return {number: names[number] for number in sorted(names) if number}


def size_of(scene: Any) -> tuple[int, int]:
    """The width and height of a picture in px."""
    percentage = scene.render.resolution_percentage
    render = scene.render
    return render.resolution_x * percentage // 100, render.resolution_y * percentage // 100


def camera_of(scene: Any, name: str) -> dict[str, Any]:
    """A view's camera as a record: K, R and t by OpenCV's axes, pixel centres at +0.5.

    Raises:
        RefusedError: it is no perspective camera.
    """
    camera = scene.camera
    if camera.data.type != "PERSP":
        raise RefusedError(f"camera {camera.name}: {camera.data.type}; expected a perspective one")
    width, height = size_of(scene)
    aspect = {"scale_x": scene.render.pixel_aspect_x, "scale_y": scene.render.pixel_aspect_y}
    depsgraph = bpy.context.evaluated_depsgraph_get()
    shape = camera.calc_matrix_camera(depsgraph, x=width, y=height, **aspect)
    fx, fy = shape[0][0] * width / 2, shape[1][1] * height / 2
    cx, cy = (1 - shape[0][2]) * width / 2, (1 + shape[1][2]) * height / 2
    place = camera.evaluated_get(depsgraph).matrix_world
    rotation = FLIP @ place.to_3x3().normalized().transposed()
    return {
        "file": f"{name}.exr",
        "width": width,
        "height": height,
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "R": [list(row) for row in rotation],
        "t": list(-(rotation @ place.translation)),
    }


def set_camera(scene: Any, record: Mapping[str, Any]) -> None:
    """Make the scene's camera that of a record, see :func:`camera_of`."""
    camera, rotation = scene.camera, Matrix(record["R"])
    turned = (FLIP @ rotation).transposed()
    place = -(rotation.transposed() @ Vector(record["t"]))
    width, height = record["width"], record["height"]
    (fx, _, cx), (_, fy, cy) = record["K"][0], record["K"][1]
    data = camera.data
    data.type, data.sensor_fit, data.sensor_width = "PERSP", "HORIZONTAL", 36.0
    data.lens = fx * 36.0 / width
    data.shift_x, data.shift_y = (width / 2 - cx) / width, (cy - height / 2) * fx / fy / width
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(fy / fx, 1), max(fx / fy, 1)
    camera.constraints.clear()
    camera.animation_data_clear()
    data.animation_data_clear()
    camera.parent = None
    camera.matrix_world = Matrix.Translation(place) @ turned.to_4x4()


def target_of(scene: Any) -> Any:
    """What the scene's camera looks at: what it sees in its middle, else the middle of all."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    place = scene.camera.evaluated_get(depsgraph).matrix_world
    forward = -place.col[2].to_3d().normalized()
    hit, where, *_ = scene.ray_cast(depsgraph, place.translation, forward)
    if hit:
        return where
    corners = [
        each.matrix_world @ Vector(corner)
        for each in scene.objects
        if each.type in GEOMETRY and not each.hide_render
        for corner in each.bound_box
    ]
    if not corners:
        raise RefusedError("it has no objects")
    return sum(corners, Vector()) / len(corners)


def paths(scene: Any, asked: Mapping[str, Any]) -> Iterator[Any]:
    """The cameras of generated views: an orbit, an arc, or places in a box.

    Yields:
        Matrices, as a camera's ``matrix_world``.
    """
    count, path = asked["count"], asked["path"]
    bpy.context.view_layer.update()
    start, target = scene.camera.matrix_world.copy(), target_of(scene)
    if path in ("orbit", "arc"):
        for number in range(count):
            angle = 2 * math.pi * number / count
            if path == "arc":
                angle = SPAN * (number / max(count - 1, 1) - 0.5)
            about = Matrix.Translation(target) @ Matrix.Rotation(angle, 4, "Z")
            yield about @ Matrix.Translation(-target) @ start
        return
    draw = random.Random(asked["seed"])  # noqa: S311 - places, no secrets
    reach = (start.translation - target).length / 4
    middle = start.translation
    box = asked["box"] or [c - reach for c in middle] + [c + reach for c in middle]
    for _ in range(count):
        place = Vector([draw.uniform(a, b) for a, b in zip(box[:3], box[3:], strict=True)])
        turned = (target - place).to_track_quat("-Z", "Y")
        yield Matrix.Translation(place) @ turned.to_matrix().to_4x4()


def views_of(scene: Any, asked: Mapping[str, Any]) -> Iterator[tuple[str, int, Callable[[], None]]]:
    """The views to render: the name and number of each, and what sets the scene up for it."""
    views = asked["views"]
    if "frames" in views:
        digits = max(4, len(str(max(views["frames"]))))
        for frame in views["frames"]:
            yield f"frame_{frame:0{digits}d}", frame, partial(scene.frame_set, frame)
    elif "cameras" in views:
        for number, record in enumerate(views["cameras"]):
            yield record["name"], number, partial(set_camera, scene, record)
    else:
        matrices = list(paths(scene, views))
        camera = scene.camera
        camera.constraints.clear()
        camera.animation_data_clear()
        camera.parent = None
        digits = max(3, len(str(len(matrices) - 1)))
        for number, matrix in enumerate(matrices):
            yield (
                f"view_{number:0{digits}d}",
                number,
                partial(setattr, camera, "matrix_world", matrix),
            )


def sees_something(scene: Any, record: Mapping[str, Any]) -> bool:
    """Whether rays through a view's picture meet a surface."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    place = scene.camera.evaluated_get(depsgraph).matrix_world
    (fx, _, cx), (_, fy, cy) = record["K"][0], record["K"][1]
    for row in range(9):
        for column in range(9):
            x = ((column + 0.5) / 9 * record["width"] - cx) / fx
            y = ((row + 0.5) / 9 * record["height"] - cy) / fy
            ray = place.to_3x3().normalized() @ Vector((x, -y, -1)).normalized()
            if scene.ray_cast(depsgraph, place.translation, ray)[0]:
                return True
    return False


def render_view(scene: Any, folder: str, name: str, number: int, seed: int) -> None:
    """Render a view into NAME.exr, which is there whole or not at all.

    Raises:
        RefusedError: it cannot be rendered or written.
    """
    unfinished = os.path.join(folder, f".{name}.{os.getpid()}{UNFINISHED}")
    settings = scene.render.image_settings
    if hasattr(settings, "use_exr_interleave"):
        # Blender 5.0 cannot write parts of pixels that are not square.
        is_square = scene.render.pixel_aspect_x == scene.render.pixel_aspect_y
        settings.use_exr_interleave = not is_square
    scene.cycles.seed = (seed + number) % 2**31
    scene.render.filepath = unfinished
    try:
        bpy.ops.render.render(write_still=True)
    except RuntimeError as error:
        raise RefusedError(f"view {name}: {' '.join(str(error).split())}") from None
    forget_times(unfinished)
    os.replace(unfinished, os.path.join(folder, f"{name}.exr"))


def forget_times(path: str) -> None:
    """Take the seconds that rendering took out of an EXR's header, for the same bytes each time."""
    with open(path, "r+b") as file:
        head = file.read(2**17)
        file.seek(0)
        file.write(TIMES.sub(lambda found: found[1] + re.sub(rb"[0-9]", b"0", found[2]), head))


def main(asked: Mapping[str, Any]) -> None:
    """Render all views that are not there yet."""
    scene = open_scene(asked["scene"])
    if scene.camera is None:
        raise RefusedError("it has no camera; add one, or name cameras with --poses")
    prepare(scene, asked)
    objects = number_objects(scene)
    views, cameras, blind = list(views_of(scene, asked)), [], []
    for name, _, set_up in views:
        set_up()
        bpy.context.view_layer.update()
        cameras.append(camera_of(scene, name))
        if not sees_something(scene, cameras[-1]):
            blind.append(name)
    if blind:
        raise RefusedError(
            f"{len(blind)} of {len(views)} views see nothing: {', '.join(blind[:5])}"
        )
    unit = scene.unit_settings
    tell(
        "scene",
        blender=bpy.app.version_string,
        views=cameras,
        objects=objects,
        layers=["Depth", "Normal", "Object Index" if bpy.app.version >= (5, 0) else "IndexOB"],
        unit_metres=unit.scale_length if unit.system != "NONE" else None,
    )
    for name in os.listdir(asked["folder"]):
        if name.endswith(UNFINISHED):  # of a Blender that was killed
            os.remove(os.path.join(asked["folder"], name))
    for name, number, set_up in views:
        seconds = 0.0
        if not os.path.exists(os.path.join(asked["folder"], f"{name}.exr")):
            began = time.perf_counter()
            set_up()
            render_view(scene, asked["folder"], name, number, asked["seed"])
            seconds = time.perf_counter() - began
        tell("rendered", name=name, seconds=seconds)


if __name__ == "__main__":
    with open(sys.argv[-1], encoding="utf-8") as file:
        ASKED = json.load(file)
    try:
        main(ASKED)
    except RefusedError as error:
        tell("refused", message=str(error))
        sys.exit(1)
