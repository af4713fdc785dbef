"""Makes the contents of a sidecar: everything that is needed to recompute its picture."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

from clpipe.base.about import FORMAT, FORMAT_KEY, __version__
from clpipe.base.files import Stored
from clpipe.chain.camera_info import camera_info
from clpipe.chain.chain import Chain
from clpipe.chain.photometry import photometry_of
from clpipe.chain.registry import all_stages
from clpipe.chain.render_camera import POSE
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.engine.state import has_state
from clpipe.images.read import SourceImage
from clpipe.images.tags import FLIPS, orientation_of
from clpipe.inputs.carry import CarriedLayers
from clpipe.inputs.jobs import Job
from clpipe.inputs.raw import RawImage
from clpipe.outputs.motion import motion_records, row_times
from clpipe.outputs.patches import Patch, metadata_of
from clpipe.outputs.program import all_versions, device_record, program_digest
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.sidecar import VERSION_KEY, CachedJson, sidecar_bytes
from clpipe.reference.intrinsics import Intrinsics
from clpipe.stage import ImageLayer

PLACE = "place"  # the entry of a picture that depends on the frames before, with its place

METADATA, PATCHES = "facts", "patches"  # keys of a sidecar of patches

REPEATED_KEYS = ("image_key", "noise_key", "iso", "noise")  # keys that sidecars of patches repeat


def intrinsics_of(chain: Chain, source: SourceImage) -> Intrinsics | None:
    """Return the intrinsics of the picture of a render or a photograph; None if not known.

    The picture of a photograph is rotated upright. The intrinsics of a raw are not known. If the
    chain starts after its first step, they are not known either, because a lens may have been
    applied before.

    Raises:
        RequestError: the render's camera contradicts a lens of the chain.
    """
    if isinstance(source, RawImage) or chain.steps[0].name != chain.names[0]:
        return None
    height, width = source.pixels.shape[:2]
    *_, is_transposed = FLIPS[orientation_of(source.attributes)]
    if is_transposed:
        width, height = height, width
    return chain.intrinsics(width, height, source.shot)


def subframe_records(
    source: SourceImage, stamps: Sequence[tuple[int, int]]
) -> list[dict[str, Any]]:
    """Return the entries of the files that an exposure averages, relative to the first's folder."""
    return [
        {"file": name, "size": size, "modified": modified, "sha256": digest}
        for (name, digest), (size, modified) in zip(source.subframes, stamps, strict=True)
    ]


def layer_records(layers: Iterable[ImageLayer]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the sources of the layers that steps have read, by kind."""
    records: dict[str, list[Mapping[str, Any]]] = {}
    for layer in layers:
        records.setdefault(layer.kind, []).append(layer.record)
    return records


def picture_record(
    job: Job,
    request: Mapping[str, Any],
    stamps: Sequence[tuple[int, int]],
    recipe: Recipe,
    device: Device | None,
    source: SourceImage,
    result: Result,
    outputs: Mapping[Path, Stored],
    clipped: float | None,
    carried: CarriedLayers | None = None,
    patches: Sequence[Patch] = (),
) -> dict[str, Any]:
    """Return everything that is needed to recompute the files of a rendition, as JSON values.

    Args:
        job: the image.
        request: the record of the request for the image.
        stamps: the size and modification time of each input file, from before it was read.
        recipe: the recipe of the picture.
        device: the device that made it; None is NumPy.
        source: the image, as it was loaded.
        result: the result of the chain.
        outputs: the files that were written.
        clipped: the share of clipped pixels, 0 to 1; None if the image has no upper limit.
        carried: layers that were written next to the picture.
        patches: patches that were written instead of the picture.
    """
    chain, rendition = recipe.full_chain, recipe.rendition
    facts = source.facts if isinstance(source, RawImage) else None
    noise = chain.noise if not facts or chain.is_noisy else None
    width, height = chain.size(*source.pixels.shape[1::-1])
    intrinsics = intrinsics_of(chain, source)
    return {
        VERSION_KEY: __version__,
        FORMAT_KEY: FORMAT,
        "input": job.input,
        "input_size": stamps[0][0],
        "input_modified": stamps[0][1],
        "sha256": source.sha256,
        **({"subframes": subframe_records(source, stamps)} if source.subframes else {}),
        **({"panorama": source.panorama.record} if source.panorama else {}),
        "layer": source.layer,
        "part": source.part,
        "name": job.stem,
        "picture": rendition.suffix,
        **asdict(rendition),
        "image_key": recipe.key,
        "noise_key": recipe.noise_key,
        "seed": chain.seed,
        "width": width,
        "height": height,
        "camera": chain.camera.name,
        "iso": chain.iso,
        **({PLACE: asdict(job.place)} if job.place and has_state(chain) else {}),
        **({"lens": lens.name} if (lens := chain.optics.calibration) else {}),
        "output": chain.settings.output.model_dump(exclude_defaults=True)
        | chain.settings.render.with_defaults(source.shot).model_dump(
            exclude=POSE, exclude_defaults=True
        ),
        "intrinsics": intrinsics.record() if intrinsics else None,
        "camera_info": camera_info(
            chain, result.estimates, source.pixels.shape[1::-1], intrinsics
        ).record(),
        "pose": chain.settings.render.pose,
        **motion_records(chain, source),
        **row_times(chain, source),
        "photometry": photometry_of(chain, result.estimates),
        "noise": noise.record() if noise else None,
        "starts_on": chain.source.label,
        **({"raw": asdict(facts)} if facts else {}),
        "stages": [
            each | {"estimates": result.estimates[each["name"]]}
            if each["name"] in result.estimates
            else each
            for each in stage_records(chain)
        ],
        **(patch_records(chain, patches) if patches else {}),
        "clipped": clipped if clipped is None else round(clipped, 4),
        "outputs": [
            {"name": path.name, "size": file.size, "sha256": file.sha256}
            for path, file in outputs.items()
        ],
        **({"carried": carried.records} if carried else {}),
        **layer_records(source.layers.values()),
        **({"overscan": source.margins._asdict()} if source.margins else {}),
        "warnings": list(source.warnings),
        "device": device_record(device),
        "program": program_digest(),
        "versions": all_versions(),
        "request": request,
    }


def patch_records(chain: Chain, patches: Sequence[Patch]) -> dict[str, Any]:
    """Return a sidecar's entries for patches, as JSON values: their metadata and positions."""
    facts = {k: v.tolist() if hasattr(v, "tolist") else v for k, v in metadata_of(chain).items()}
    places = [{"place": [patch.left, patch.top], "turn": patch.orientation} for patch in patches]
    return {METADATA: facts, PATCHES: places}


def patch_text(values: Mapping[str, Any], number: int) -> bytes:
    """Return a sidecar of one patch, by its number, from the values of all patches.

    Raises:
        KeyError, TypeError, IndexError: the values are damaged.
    """
    repeated = {key: values[key] for key in REPEATED_KEYS}
    return sidecar_bytes(
        {
            VERSION_KEY: values[VERSION_KEY],
            FORMAT_KEY: values.get(FORMAT_KEY, 0),
            **repeated,
            **values[METADATA],
            **values[PATCHES][number],
        }
    )


def whole_step(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of a step in a sidecar with the default values that it lacks.

    >>> whole_step({"name": "exposure", "method": "gain", "parameters": {"ev": 1.0}})["parameters"]
    {'ev': 1.0, 'headroom': 1.0, 'sets_time': True}
    """
    stage = all_stages().get(str(record.get("stage", record.get("name"))))
    methods = {each.method: each for each in stage.methods} if stage else {}
    method, own = methods.get(str(record.get("method"))), record.get("parameters", {})
    fields = method.model_fields if method and isinstance(own, dict) else {}
    defaults = {name: each.default for name, each in fields.items()}
    return {**record, "parameters": {**defaults, **own} if fields else own}


@lru_cache(maxsize=8)
def stage_records(chain: Chain) -> list[dict[str, Any]]:
    """Return a sidecar's entry for the steps of a chain, as JSON values that images share.

    Parameters that have the default of their method are missing, and so is a stage's name if the
    step has it.
    """
    return [
        CachedJson(
            name=step.name,
            **({} if step.name == step.stage.name else {"stage": step.stage.name}),
            method=step.method.method,
            **({"parameters": own} if own else {}),
        )
        for step in chain.steps
        for own in [step.method.model_dump(exclude_defaults=True)]
    ]
