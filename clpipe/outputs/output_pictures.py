"""Reads the pictures of an output directory, with their cameras, from its sidecars."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from clpipe.chain.formats import DNG, extension_of
from clpipe.chain.render_camera import Matrix, Vector
from clpipe.chain.rendition import BASELINES, NOISY, PICTURES, Rendition, Role
from clpipe.outputs.carried import carried_files
from clpipe.outputs.shared import RESPONSE, SHARED, shared_path, with_shared
from clpipe.outputs.sidecar import SIDECAR, SidecarError, output_entries, sidecar_files, values_at
from clpipe.reference.intrinsics import COEFFICIENTS, OPENCV, OPENCV_FISHEYE, PINHOLE, Intrinsics

# A training set has one kind of picture. Camera models of noisy pictures are at the top of the
# output directory, and those of other kinds are in models/.
OTHERS = (*PICTURES, *BASELINES)

MODEL_FOLDERS = {NOISY: "", **{role: f"models/{Rendition(role).label[1:]}/" for role in OTHERS}}

CHANGED = "not in these files, because a sidecar was changed after clpipe wrote it"

CAMERA = TypeAdapter(Intrinsics)

POSE: TypeAdapter[tuple[Matrix, Vector]] = TypeAdapter(tuple[Matrix, Vector])
TABLE: TypeAdapter[dict[str, Any] | None] = TypeAdapter(dict[str, Any] | None)


@dataclass(frozen=True)
class OutputPicture:
    """A picture of an output directory.

    Args:
        file: its path in the directory.
        role: the role of its rendition.
        camera: its intrinsics.
        pose: R, (3, 3), and t, (3,), from world to camera; None if they are not known.
        photometry: see :func:`clpipe.chain.photometry.photometry_of`.
        motion: see :func:`clpipe.outputs.motion.motion_records`.
        name: the name of its image in the sidecar.
        depth: the path of its depth PNG in millimetres; "" if there is none.
    """

    file: str
    role: Role
    camera: Intrinsics
    pose: tuple[Matrix, Vector] | None
    photometry: Mapping[str, Any] | None = None
    motion: Mapping[str, Any] | None = None
    name: str = ""
    depth: str = ""


def output_pictures(folder: Path, skipped: Mapping[str, list[str]]) -> Iterator[OutputPicture]:
    """Yield the pictures that the sidecars of a folder list, in the first format except DNG.

    They include frames of bursts and exposures of brackets, but no mosaics.

    Args:
        folder: the output directory.
        skipped: receives the names of pictures that are skipped, by reason.
    """
    for path in sidecar_files(folder):
        shown = path.relative_to(folder).as_posix()
        try:
            values = with_shared(values_at(path) or {}, path.parent)
            role = values and Rendition.from_record(values).role
            file = values and picture_of(path, values) if role in MODEL_FOLDERS else None
            if not values or not role or not file:
                continue
            shown = file.relative_to(folder).as_posix()
            if values["intrinsics"] is None:
                skipped["not in these files, because they need the focal length"].append(shown)
                continue
            camera = CAMERA.validate_python(values["intrinsics"])
            pose = values["pose"]
            pose_values = pose and POSE.validate_python((pose["R"], pose["t"]))
            layers, files = values.get("carried", ()), carried_files(values)
            depths = [files.get(each["layer"]) for each in layers if each["kind"] == "depth"]
            depth = next((Path(shown).with_name(name).as_posix() for name in depths if name), "")
            if values["photometry"] and RESPONSE not in values["photometry"]:
                lost = shared_path(Path(), str(values.get(SHARED))).name
                reason = f"in these files without its response to greys, because {lost} is missing"
                skipped[reason].append(shown)
            remaining = *_photometry_and_motion(values), str(values["name"]), depth
            yield OutputPicture(shown, role, simplest_model(camera), pose_values, *remaining)
        except SidecarError:
            skipped[f"{CHANGED}; repeat the same clpipe run"].append(shown)
        except (KeyError, TypeError, ValueError):
            reason = "not in these files, because a sidecar is damaged or of another version"
            skipped[reason].append(shown)


def _photometry_and_motion(
    values: Mapping[str, Any],
) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
    """Return the photometry of a sidecar's picture, and the motion during its exposure.

    Raises:
        KeyError, TypeError, ValueError: the values are damaged.
    """
    photometry = TABLE.validate_python(values["photometry"])
    motion = TABLE.validate_python(values.get("motion"))
    if photometry is not None:
        float(photometry["gain"])
        TABLE.validate_python(photometry.get(RESPONSE))
    if motion:
        for name in ("first_row", "last_row"):
            POSE.validate_python((motion[name]["R"], motion[name]["t"]))
        float(motion["exposure_time"]), float(motion["readout_time"])
    return photometry, motion


def picture_of(sidecar: Path, values: Mapping[str, Any]) -> Path | None:
    """Return the picture file of a sidecar, or None if there is none.

    Raises:
        KeyError, TypeError, ValueError: the values are damaged.
    """
    formats = [each for each in values["request"]["formats"] if each != DNG]
    if not formats:
        return None
    file = sidecar.with_name(f"{sidecar.name.removesuffix(SIDECAR)}{extension_of(formats[0])}")
    return file if file.name in output_entries(values) and file.exists() else None


def simplest_model(camera: Intrinsics) -> Intrinsics:
    """Return the camera in the simplest COLMAP model that describes it exactly.

    Raises:
        KeyError: there is no such model.

    >>> camera = Intrinsics(4, 3, 5, 5, 2, 1.5, "FULL_OPENCV", {"k1": 0.1, "k2": 0.0, "k4": 0.0})
    >>> simplest_model(camera).model, simplest_model(camera).distortion["k1"]
    ('OPENCV', 0.1)
    """
    nonzero = {name for name, value in camera.distortion.items() if value}
    simple = () if camera.model == OPENCV_FISHEYE else (PINHOLE, OPENCV)
    model = next((each for each in simple if nonzero <= {*COEFFICIENTS[each]}), camera.model)
    coefficients = {name: camera.distortion.get(name, 0.0) for name in COEFFICIENTS[model]}
    return replace(camera, model=model, distortion=coefficients)


def lens_record(camera: Intrinsics) -> dict[str, Any]:
    """Return a lens as in cameras.json: COLMAP's model, and its coefficients by name."""
    return {"model": camera.model, "distortion": dict(camera.distortion)}
