"""The source of a dataset's renders: a running Blender, or a folder of renders."""

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from clpipe.base.digests import digests
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import check_exists
from clpipe.images.passes import find_layers, layer_kind
from clpipe.inputs.jobs import Job
from clpipe.outputs.camera_formats import CAMERAS, TRANSFORMS
from clpipe.scenes.blender import Renderer, RenderError, Rendering, Scene
from clpipe.scenes.leaves import dead_leaves, read_palette, write_leaves
from clpipe.scenes.record import read_record, write_record
from clpipe.scenes.view_request import dependencies

RENDERS, UNIT, NOTE = "renders", "Unit of depth and poses", "Which views"
FLOW = "Vector"  # name of Blender's flow layer, for frames


@dataclass
class Source:
    """The renders of a dataset.

    Args:
        inputs: the inputs of clpipe run that contain them.
        poses: the file of their cameras; None if they are not known.
        layers: the layers to carry.
        about: texts for the dataset's card, by title.
        renderer: the Blender that renders them; None if all exist.
        names: the names of the views in order, if Blender renders them.
        faces: the names of a cube's faces, each a file of its own; empty if a view is one file.
        failure: the reason why rendering ended early.
    """

    inputs: list[str]
    poses: Path | None
    layers: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)
    renderer: Renderer | None = None
    names: Sequence[str] = ()
    faces: Sequence[str] = ()
    failure: RenderError | None = None
    _is_stopped: bool = False

    def jobs(self) -> list[Job] | None:
        """Return the jobs of views that Blender renders; None if renders exist in a folder."""
        (folder,) = self.inputs
        jobs = []
        for name in self.names:
            files = [Path(folder) / f"{name}_{face}.exr" for face in self.faces]
            first, *others = files or [Path(folder) / f"{name}.exr"]
            found = Job(first, f"{name}.exr", named_by_user=False)
            jobs.append(replace(found, subframes=tuple(others), is_panorama=bool(files)))
        return jobs or None

    def stop(self) -> None:
        """Stop rendering."""
        self._is_stopped = True
        if self.renderer:
            self.renderer.stop()

    def jobs_when_rendered(self, jobs: Sequence[Job], show: Callable[[str], None]) -> Iterator[Job]:
        """Yield the jobs, each as soon as its render is finished.

        If rendering fails, the rest is missing, and ``failure`` contains the reason.

        Args:
            jobs: the jobs; all jobs of a render are consecutive.
            show: prints a line.
        """
        if not self.renderer:
            yield from jobs
            return
        jobs_by_render: dict[str, list[Job]] = {}
        for job in jobs:
            jobs_by_render.setdefault(job.key, []).append(job)
        try:
            for number, (name, seconds) in enumerate(self.renderer.rendered(len(self.names)), 1):
                if seconds > 0:
                    show(f"rendered {name}  {number} of {len(self.names)}  {seconds:.1f} s")
                yield from jobs_by_render[f"{name}.exr"]
        except RenderError as error:
            self.failure = None if self._is_stopped else error


def from_folder(folder: Path, output: Path, poses: Path | None) -> Source:
    """Return existing renders with their layers, and the given cameras or those in the folder.

    Raises:
        RequestError: there is no such folder, or the output directory has another dataset.
    """
    check_exists(folder)
    if not folder.is_dir():
        raise RequestError(f"{folder}: this is neither a .blend nor a folder of renders; give one")
    origin = {"renders": folder.resolve().name}
    read_record(output, origin)
    layers_of_file = [path for name in (CAMERAS, TRANSFORMS) if (path := folder / name).is_file()]
    write_record(output, origin, {})
    about = {"Renders": f"`{folder.resolve().name}`"}
    return Source(
        [str(folder)], poses or next(iter(layers_of_file), None), layers_in(folder), about
    )


def from_leaves(
    output: Path,
    count: int,
    size: tuple[int, int],
    seed: int,
    palette: Path | None,
    show: Callable[[str], None],
) -> Source:
    """Return dead leaves images, which are made unless they exist.

    Args:
        output: the folder of the dataset.
        count: the number of images.
        size: their width and height in px.
        seed: the seed.
        palette: a render or photograph with the colours; None draws colours.
        show: prints a line.

    Raises:
        RequestError: the size is not possible, or the output directory has another dataset.
        ImageError: the palette cannot be read, or an image cannot be written.
    """
    colours = read_palette(palette) if palette else None
    sha256 = digests([str(palette)])[str(palette)] if palette else ""
    origin = {"leaves": list(size), "seed": seed, "palette": sha256}
    read_record(output, origin)
    folder = output / RENDERS
    for number in range(count):
        path = folder / f"leaves_{number:05}.exr"
        if not path.exists():
            image = dead_leaves(*size, seed, number, colours)  # raises an error for a wrong size
            write_record(output, origin, {})
            folder.mkdir(parents=True, exist_ok=True)
            write_leaves(path, image)
            show(f"made {path.stem}  {number + 1} of {count}")
    about = {
        "Renders": f"`{RENDERS}/`, dead leaves (Lee, Mumford and Huang 2001) with textures, which "
        f"clpipe made from the seed {seed}; linear Rec. 709, with depth and the numbers of leaves",
        UNIT: "arbitrary: leaves are from 1 to 10 deep",
    }
    return Source([str(folder)], None, ("Depth:png", "IndexOB"), about)


def layers_in(folder: Path) -> tuple[str, ...]:
    """Return values of --carry for the depth, labels, normals and flow in every EXR of a folder."""
    common: dict[str, str] | None = None
    for path in sorted(folder.rglob("*.exr")):
        try:
            found = find_layers(path)
        except ImageError:  # the run reports it
            continue
        layers_of_file: dict[str, str] = {
            each.without_rank.rpartition(".")[2]: kind
            for each in found
            if (kind := layer_kind(each.name, each)) and kind != "colour" and each.name
        }
        common = (
            layers_of_file
            if common is None
            else {k: v for k, v in common.items() if layers_of_file.get(k) == v}
        )
    return tuple(_carry_value(name, kind) for name, kind in (common or {}).items())


def _carry_value(name: str, kind: str) -> str:
    """Return the value of --carry for a layer, with PNGs of depth and object indices."""
    is_plain = kind == "depth" or (kind == "label" and name.lower().startswith(("index", "object")))
    return f"{name}:png" if is_plain else name


def from_scene(stack: ExitStack, rendering: Rendering, output: Path, program: str | None) -> Source:
    """Return the renders of a scene. Blender is started unless all of them exist.

    Args:
        stack: ends Blender when it is closed.
        rendering: the request, for the folder ``renders`` in the output directory.
        output: the folder of the dataset.
        program: an installed Blender; None is the package bpy.

    Raises:
        RequestError: the scene cannot be rendered, there is no Blender, or the output directory
            has another dataset.
    """
    request = rendering.record()
    path, views = rendering.scene, request.pop("views")
    sha256 = digests([str(path)]).get(str(path))
    if sha256 is None:
        check_exists(path)
        raise RequestError(f"{path}: this scene cannot be read; check its permissions")
    del request["folder"]
    origin = {**request, "scene": path.name, "sha256": sha256, "views": dependencies(views)}
    origin = json.loads(json.dumps(origin))
    stored = read_record(output, origin)
    renderer = None
    faces = list(rendering.faces["turns"]) if rendering.faces else []
    if stored.get("views") == views and _all_exist(rendering.folder, stored["scene"], faces):
        scene = Scene(**stored["scene"])
    else:
        renderer = stack.enter_context(Renderer(rendering, program))
        scene = renderer.scene()
        write_record(output, origin, {"views": views, "scene": asdict(scene)})
        cameras = {"views": scene.views}
        write_new(rendering.folder / CAMERAS, json.dumps(cameras, indent=1).encode())
    depth, normals, numbers = scene.layers
    layers = (f"{depth}:png", normals, f"{numbers}:png", *([FLOW] if "frames" in views else []))
    names = [Path(view["file"]).stem for view in scene.views]
    folder = output / RENDERS
    about = _about(rendering, scene)
    return Source([str(folder)], folder / CAMERAS, layers, about, renderer, names, faces)


def _all_exist(folder: Path, scene: Mapping[str, Any], faces: Sequence[str]) -> bool:
    names = [view["file"] for view in scene["views"]]
    if faces:
        names = [f"{Path(name).stem}_{face}.exr" for name in names for face in faces]
    return os.path.isfile(folder / CAMERAS) and all(os.path.isfile(folder / n) for n in names)


def _about(rendering: Rendering, scene: Scene) -> dict[str, str]:
    """Return the card's texts about the renders, by title."""
    limit = f", at most {rendering.time_limit:g} s per view" if rendering.time_limit else ""
    unit = f"{scene.unit_metres:g} m" if scene.unit_metres else "not stated by the scene"
    objects = ", ".join(f"{number} {' + '.join(n)}" for number, n in scene.objects.items())
    denoised = "denoised by Open Image Denoise" if rendering.denoise else "not denoised"
    limits = "; with a time limit, pictures depend on the machine" if rendering.time_limit else ""
    return {
        "Scene": f"`{rendering.scene.name}`, rendered by Blender {scene.blender}",
        "Renders": f"`{RENDERS}/`, Cycles, {rendering.samples} samples{limit}, {denoised}; "
        "linear Rec. 709, half floats, with depth, normals and object indices",
        UNIT: unit,
        "Objects": objects or "none",
        **({NOTE: "; ".join(scene.notes)} if scene.notes else {}),
        "Reproducible": "the same Blender on the same kind of processor renders the same pixels"
        + limits,
    }
