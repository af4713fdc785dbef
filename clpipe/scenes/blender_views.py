"""Chooses the views of a scene, and checks that they see enough of it.

Blender's own Python runs it, without clpipe, for :mod:`clpipe.scenes.blender_script`.
"""

import math
import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import bpy
from mathutils import Matrix, Vector

FLIP = Matrix(((1, 0, 0), (0, -1, 0), (0, 0, -1)))  # from Blender's camera axes to OpenCV's
GEOMETRY = {"MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD"}
SPAN = math.radians(60)  # the angle of an arc
RAYS = 9  # per row and per column of a picture, to test what a view sees
FILLED, FLAT = 0.85, 0.98  # share of a picture and cosine between normals at which a wall fills it
NEARER = 0.8  # an object in the way is nearer than this share of the distance to the target
FINER = 16  # candidates on a path for each view
DRAWS = 50  # candidates in a box for each view, at most

View = tuple[str, int, Callable[[], object]]  # name, number, and a function that sets up the scene


class RefusedError(Exception):
    """An error that the user can correct."""


def size_of(scene: Any) -> tuple[int, int]:
    """Return the width and height of a picture in px."""
    percentage = scene.render.resolution_percentage
    render = scene.render
    return render.resolution_x * percentage // 100, render.resolution_y * percentage // 100


def camera_of(scene: Any, name: str) -> dict[str, Any]:
    """Return a view's camera as a record: K, R and t in OpenCV's axes, pixel centres at +0.5.

    Raises:
        RefusedError: the camera is not a perspective camera.
    """
    camera = scene.camera
    if camera.data.type != "PERSP":
        raise RefusedError(
            f"camera {camera.name} has the type {camera.data.type}; make it a perspective camera"
        )
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
    """Set the scene's camera from a record, see :func:`camera_of`."""
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


def face_camera(scene: Any) -> Any:
    """Return a new camera for faces of a cube, which follows the scene's camera."""
    data = scene.camera.data.copy()
    data.animation_data_clear()
    data.type, data.sensor_fit, data.angle = "PERSP", "AUTO", math.radians(90)
    data.shift_x = data.shift_y = 0
    data.dof.use_dof = False
    face = bpy.data.objects.new("clpipe face", data)
    scene.collection.objects.link(face)
    face.parent = scene.camera
    return face


def set_face(scene: Any, face: Any, turn: list[list[float]], side: int) -> None:
    """Make a face of a cube the scene's view.

    Args:
        scene: the scene, with its camera in place.
        face: see :func:`face_camera`.
        turn: the rotation from the face's axes to the camera's, in OpenCV's axes.
        side: width and height of the face in px.
    """
    face.matrix_basis = (FLIP @ Matrix(turn) @ FLIP).to_4x4()
    render = scene.render
    render.resolution_x = render.resolution_y = side
    render.resolution_percentage, render.pixel_aspect_x, render.pixel_aspect_y = 100, 1, 1
    scene.camera = face
    bpy.context.view_layer.update()


def target_of(scene: Any) -> Any:
    """Return the point in the centre of the camera's view, or else the centre of all objects."""
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
        raise RefusedError("this scene has no objects to render; add one")
    return sum(corners, Vector()) / len(corners)


def place_on(path: str, share: float, start: Any, target: Any) -> Any:
    """Return the ``matrix_world`` of a camera on an orbit or arc, at a share of it, 0 to 1."""
    angle = 2 * math.pi * share if path == "orbit" else SPAN * (share - 0.5)
    about = Matrix.Translation(target) @ Matrix.Rotation(angle, 4, "Z")
    return about @ Matrix.Translation(-target) @ start


def on_path(scene: Any, asked: Mapping[str, Any], start: Any, target: Any) -> tuple[list[Any], str]:
    """Return the cameras of an orbit or arc, and a note if some places on it see too little.

    Places are evenly spaced. If one of them sees too little, they are chosen evenly among finer
    places that see enough.

    Raises:
        RefusedError: too few places see enough.
    """
    count, path = asked["count"], asked["path"]
    whole = count if path == "orbit" else max(count - 1, 1)
    places = [place_on(path, number / whole, start, target) for number in range(count)]
    reasons = [fault for place in places if (fault := fault_of(scene, place, target))]
    if not reasons:
        return places, ""
    steps = FINER * count
    finer = [place_on(path, (k + 0.5) / steps, start, target) for k in range(steps)]
    good = [place for place in finer if not fault_of(scene, place, target)]
    if len(good) < count:
        raise RefusedError(
            f"only {len(good)} of {steps} places on the {path} see enough ({most_of(reasons)}); "
            "move the scene's camera, or use --path random --box, or --poses"
        )
    note = (
        f"{len(reasons)} of {count} places on the {path} see too little ({most_of(reasons)}), so "
        f"the views come from the {100 * len(good) // steps} % of it that see enough"
    )
    return [good[number * len(good) // count] for number in range(count)], note


def in_box(scene: Any, asked: Mapping[str, Any], start: Any, target: Any) -> tuple[list[Any], str]:
    """Return cameras in a box that look at the target, and a note if some were drawn again.

    Raises:
        RefusedError: too few places see enough.
    """
    draw = random.Random(asked["seed"])  # noqa: S311 - places, no secrets
    reach = (start.translation - target).length / 4
    middle = start.translation
    box = asked["box"] or [c - reach for c in middle] + [c + reach for c in middle]
    found: list[Any] = []
    reasons: list[str] = []
    while len(found) < asked["count"]:
        place = Vector([draw.uniform(a, b) for a, b in zip(box[:3], box[3:], strict=True)])
        turned = (target - place).to_track_quat("-Z", "Y")
        matrix = Matrix.Translation(place) @ turned.to_matrix().to_4x4()
        if fault := fault_of(scene, matrix, target):
            reasons.append(fault)
        else:
            found.append(matrix)
        if len(reasons) > DRAWS * asked["count"]:
            raise RefusedError(
                f"only {len(found)} of {len(reasons) + len(found)} places in the box see enough "
                f"({most_of(reasons)}); choose another --box"
            )
    views = "view was" if len(reasons) == 1 else "views were"
    return found, f"{len(reasons)} {views} drawn again: {most_of(reasons)}" if reasons else ""


def most_of(reasons: list[str]) -> str:
    """Return the most frequent of some texts."""
    return max(dict.fromkeys(reasons), key=reasons.count)


def views_of(scene: Any, asked: Mapping[str, Any]) -> tuple[list[View], list[str]]:
    """Return the views to render, and notes.

    Raises:
        RefusedError: too few places see enough.
    """
    views = asked["views"]
    if "frames" in views:
        digits = max(4, len(str(max(views["frames"]))))
        numbered = [(f"frame_{f:0{digits}d}", f) for f in views["frames"]]
        return [(name, frame, partial(scene.frame_set, frame)) for name, frame in numbered], []
    if "cameras" in views:
        records = enumerate(views["cameras"])
        return [(r["name"], number, partial(set_camera, scene, r)) for number, r in records], []
    bpy.context.view_layer.update()
    start, target = scene.camera.matrix_world.copy(), target_of(scene)
    camera = scene.camera
    camera.constraints.clear()
    camera.animation_data_clear()
    camera.parent = None
    generate = in_box if views["path"] == "random" else on_path
    matrices, note = generate(scene, views, start, target)
    digits = max(3, len(str(len(matrices) - 1)))
    placed: list[View] = [
        (f"view_{number:0{digits}d}", number, partial(setattr, camera, "matrix_world", matrix))
        for number, matrix in enumerate(matrices)
    ]
    return placed, [note] if note else []


def fault_of(scene: Any, matrix: Any, target: Any) -> str:
    """Return why a camera at this place would see too little; "" if it sees enough."""
    scene.camera.matrix_world = matrix
    bpy.context.view_layer.update()
    return fault_in(scene, camera_of(scene, ""), target)


def fault_in(scene: Any, record: Mapping[str, Any], target: Any = None) -> str:
    """Return why the scene's camera sees too little, by casting rays; "" if it sees enough.

    Args:
        scene: the scene, with its camera in place.
        record: the record of the camera, see :func:`camera_of`.
        target: the point that it should see; None for no particular point.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    place = scene.camera.evaluated_get(depsgraph).matrix_world
    turn, eye = place.to_3x3().normalized(), place.translation
    (fx, _, cx), (_, fy, cy) = record["K"][0], record["K"][1]
    seen: list[tuple[str, Any]] = []  # the object that each ray meets, and its normal
    behind = 0
    for row in range(RAYS):
        for column in range(RAYS):
            x = ((column + 0.5) / RAYS * record["width"] - cx) / fx
            y = ((row + 0.5) / RAYS * record["height"] - cy) / fy
            ray = turn @ Vector((x, -y, -1)).normalized()
            hit, _, normal, _, met, _ = scene.ray_cast(depsgraph, eye, ray)
            if hit:
                seen.append((met.name, normal))
                behind += normal.dot(ray) > 0
    if not seen:
        return "it sees no objects"
    if behind > len(seen) / 2:
        return "most surfaces are seen from behind"
    names = [name for name, _ in seen]
    name = most_of(names)
    normals = [normal for own, normal in seen if own == name]
    share = len(normals) / RAYS**2
    if share > FILLED and all(normal.dot(normals[0]) > FLAT for normal in normals):
        return f"{name} fills the view"
    if target is not None:
        way = target - eye
        hit, where, _, _, met, _ = scene.ray_cast(depsgraph, eye, way.normalized())
        nearer = hit and (where - eye).length < NEARER * way.length
        if nearer and names.count(met.name) > len(seen) / 2:
            return f"{met.name} hides the target"
    return ""
