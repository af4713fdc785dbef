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

FLIP = Matrix(((1, 0, 0), (0, -1, 0), (0, 0, -1)))  # converts Blender's camera axes to OpenCV's
GEOMETRY = {"MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD"}
ARC_ANGLE = math.radians(60)
# Rays per row and per column of a picture, to test what a view sees.
RAY_GRID = 9
# Share of the picture, and cosine between its normals, above which a flat surface fills the view.
FILLED_SHARE, FLAT_COSINE = 0.85, 0.98
OCCLUDER_SHARE = 0.8  # an occluder is nearer than this share of the target's distance
CANDIDATES_PER_VIEW = 16  # candidates on a path for each view
MAX_DRAWS = 50  # the most candidates in a box for each view

View = tuple[str, int, Callable[[], object]]  # name, number, and a function that sets up the scene


class SceneError(Exception):
    """An error that the user can correct."""


def size_of(scene: Any) -> tuple[int, int]:
    """Return the width and height of a picture in px."""
    percentage = scene.render.resolution_percentage
    render = scene.render
    return render.resolution_x * percentage // 100, render.resolution_y * percentage // 100


def camera_of(scene: Any, name: str) -> dict[str, Any]:
    """Return a view's camera as a record: K, R and t in OpenCV's axes, pixel centres at +0.5.

    Raises:
        SceneError: the camera is not a perspective camera.
    """
    camera = scene.camera
    if camera.data.type != "PERSP":
        raise SceneError(
            f"camera {camera.name} has the type {camera.data.type}; make it a perspective camera"
        )
    width, height = size_of(scene)
    aspect = {"scale_x": scene.render.pixel_aspect_x, "scale_y": scene.render.pixel_aspect_y}
    depsgraph = bpy.context.evaluated_depsgraph_get()
    shape = camera.calc_matrix_camera(depsgraph, x=width, y=height, **aspect)
    fx, fy = shape[0][0] * width / 2, shape[1][1] * height / 2
    cx, cy = (1 - shape[0][2]) * width / 2, (1 + shape[1][2]) * height / 2
    matrix = camera.evaluated_get(depsgraph).matrix_world
    rotation = FLIP @ matrix.to_3x3().normalized().transposed()
    return {
        "file": f"{name}.exr",
        "width": width,
        "height": height,
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "R": [list(row) for row in rotation],
        "t": list(-(rotation @ matrix.translation)),
    }


def set_camera(scene: Any, record: Mapping[str, Any]) -> None:
    """Set the scene's camera from a record, see :func:`camera_of`."""
    camera, rotation = scene.camera, Matrix(record["R"])
    camera_rotation = (FLIP @ rotation).transposed()
    position = -(rotation.transposed() @ Vector(record["t"]))
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
    camera.matrix_world = Matrix.Translation(position) @ camera_rotation.to_4x4()


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


def set_face(scene: Any, face: Any, rotation: list[list[float]], side: int) -> None:
    """Set the scene's camera to a face of a cube.

    Args:
        scene: the scene, with its camera in place.
        face: see :func:`face_camera`.
        rotation: the rotation from the face's axes to the camera's, in OpenCV's axes.
        side: width and height of the face in px.
    """
    face.matrix_basis = (FLIP @ Matrix(rotation) @ FLIP).to_4x4()
    render = scene.render
    render.resolution_x = render.resolution_y = side
    render.resolution_percentage, render.pixel_aspect_x, render.pixel_aspect_y = 100, 1, 1
    scene.camera = face
    bpy.context.view_layer.update()


def view_target(scene: Any) -> Any:
    """Return the point in the centre of the camera's view, or else the centre of all objects."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    matrix = scene.camera.evaluated_get(depsgraph).matrix_world
    forward = -matrix.col[2].to_3d().normalized()
    hit, where, *_ = scene.ray_cast(depsgraph, matrix.translation, forward)
    if hit:
        return where
    corners = [
        each.matrix_world @ Vector(corner)
        for each in scene.objects
        if each.type in GEOMETRY and not each.hide_render
        for corner in each.bound_box
    ]
    if not corners:
        raise SceneError("this scene has no objects to render; add one")
    return sum(corners, Vector()) / len(corners)


def path_matrix(path: str, share: float, start: Any, target: Any) -> Any:
    """Return the ``matrix_world`` of a camera on an orbit or arc, at a share of it, 0 to 1."""
    angle = 2 * math.pi * share if path == "orbit" else ARC_ANGLE * (share - 0.5)
    about = Matrix.Translation(target) @ Matrix.Rotation(angle, 4, "Z")
    return about @ Matrix.Translation(-target) @ start


def path_cameras(
    scene: Any, request: Mapping[str, Any], start: Any, target: Any
) -> tuple[list[Any], str]:
    """Return the cameras of an orbit or arc, and a note if some places on it see too little.

    Places are evenly spaced. If one of them sees too little, they are chosen evenly among finer
    places that see enough.

    Raises:
        SceneError: too few places see enough.
    """
    count, path = request["count"], request["path"]
    intervals = count if path == "orbit" else max(count - 1, 1)
    matrices = [path_matrix(path, number / intervals, start, target) for number in range(count)]
    reasons = [problem for matrix in matrices if (problem := camera_problem(scene, matrix, target))]
    if not reasons:
        return matrices, ""
    steps = CANDIDATES_PER_VIEW * count
    candidates = [path_matrix(path, (k + 0.5) / steps, start, target) for k in range(steps)]
    valid = [matrix for matrix in candidates if not camera_problem(scene, matrix, target)]
    if len(valid) < count:
        raise SceneError(
            f"only {len(valid)} of {steps} places on the {path} see enough "
            f"({most_frequent(reasons)}); move the scene's camera, or use --path random --box, or "
            "--poses"
        )
    note = (
        f"{len(reasons)} of {count} places on the {path} see too little "
        f"({most_frequent(reasons)}), so the views come from the {100 * len(valid) // steps} % of "
        "it that see enough"
    )
    return [valid[number * len(valid) // count] for number in range(count)], note


def box_cameras(
    scene: Any, request: Mapping[str, Any], start: Any, target: Any
) -> tuple[list[Any], str]:
    """Return cameras in a box that look at the target, and a note if some were drawn again.

    Raises:
        SceneError: too few places see enough.
    """
    draw = random.Random(request["seed"])  # noqa: S311 - places, no secrets
    half_size = (start.translation - target).length / 4
    middle = start.translation
    box = request["box"] or [c - half_size for c in middle] + [c + half_size for c in middle]
    found: list[Any] = []
    reasons: list[str] = []
    while len(found) < request["count"]:
        position = Vector([draw.uniform(a, b) for a, b in zip(box[:3], box[3:], strict=True)])
        rotation = (target - position).to_track_quat("-Z", "Y")
        matrix = Matrix.Translation(position) @ rotation.to_matrix().to_4x4()
        if problem := camera_problem(scene, matrix, target):
            reasons.append(problem)
        else:
            found.append(matrix)
        if len(reasons) > MAX_DRAWS * request["count"]:
            raise SceneError(
                f"only {len(found)} of {len(reasons) + len(found)} places in the box see enough "
                f"({most_frequent(reasons)}); choose another --box"
            )
    views = "view was" if len(reasons) == 1 else "views were"
    return found, f"{len(reasons)} {views} drawn again: {most_frequent(reasons)}" if reasons else ""


def most_frequent(reasons: list[str]) -> str:
    """Return the most frequent of some texts."""
    return max(dict.fromkeys(reasons), key=reasons.count)


def views_of(scene: Any, request: Mapping[str, Any]) -> tuple[list[View], list[str]]:
    """Return the views to render, and notes.

    Raises:
        SceneError: too few places see enough.
    """
    views = request["views"]
    if "frames" in views:
        digits = max(4, len(str(max(views["frames"]))))
        numbered = [(f"frame_{f:0{digits}d}", f) for f in views["frames"]]
        return [(name, frame, partial(scene.frame_set, frame)) for name, frame in numbered], []
    if "cameras" in views:
        records = enumerate(views["cameras"])
        return [(r["name"], number, partial(set_camera, scene, r)) for number, r in records], []
    bpy.context.view_layer.update()
    start, target = scene.camera.matrix_world.copy(), view_target(scene)
    camera = scene.camera
    camera.constraints.clear()
    camera.animation_data_clear()
    camera.parent = None
    generate = box_cameras if views["path"] == "random" else path_cameras
    matrices, note = generate(scene, views, start, target)
    digits = max(3, len(str(len(matrices) - 1)))
    generated: list[View] = [
        (f"view_{number:0{digits}d}", number, partial(setattr, camera, "matrix_world", matrix))
        for number, matrix in enumerate(matrices)
    ]
    return generated, [note] if note else []


def camera_problem(scene: Any, matrix: Any, target: Any) -> str:
    """Return why a camera at this place would see too little, or "" if it sees enough."""
    scene.camera.matrix_world = matrix
    bpy.context.view_layer.update()
    return view_problem(scene, camera_of(scene, ""), target)


def view_problem(scene: Any, record: Mapping[str, Any], target: Any = None) -> str:
    """Cast rays to find why the scene's camera sees too little. Return "" if it sees enough.

    Args:
        scene: the scene, with its camera in place.
        record: the record of the camera, see :func:`camera_of`.
        target: the point that it should see; None for no particular point.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    matrix = scene.camera.evaluated_get(depsgraph).matrix_world
    rotation, position = matrix.to_3x3().normalized(), matrix.translation
    (fx, _, cx), (_, fy, cy) = record["K"][0], record["K"][1]
    hits: list[tuple[str, Any]] = []  # the object that each ray meets, and its normal
    back_faces = 0
    for row in range(RAY_GRID):
        for column in range(RAY_GRID):
            x = ((column + 0.5) / RAY_GRID * record["width"] - cx) / fx
            y = ((row + 0.5) / RAY_GRID * record["height"] - cy) / fy
            ray = rotation @ Vector((x, -y, -1)).normalized()
            hit, _, normal, _, object_, _ = scene.ray_cast(depsgraph, position, ray)
            if hit:
                hits.append((object_.name, normal))
                back_faces += normal.dot(ray) > 0
    if not hits:
        return "it sees no objects"
    if back_faces > len(hits) / 2:
        return "most surfaces are seen from behind"
    names = [name for name, _ in hits]
    name = most_frequent(names)
    normals = [normal for scene_camera, normal in hits if scene_camera == name]
    share = len(normals) / RAY_GRID**2
    if share > FILLED_SHARE and all(normal.dot(normals[0]) > FLAT_COSINE for normal in normals):
        return f"{name} fills the view"
    if target is not None:
        direction = target - position
        hit, where, _, _, object_, _ = scene.ray_cast(depsgraph, position, direction.normalized())
        nearer = hit and (where - position).length < OCCLUDER_SHARE * direction.length
        if nearer and names.count(object_.name) > len(hits) / 2:
            return f"{object_.name} hides the target"
    return ""
