"""The Python API of batches: what ``clpipe run`` does, as a function."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.memory import parse_size
from clpipe.base.text import as_texts
from clpipe.base.url_text import local_path
from clpipe.base.urls import path_of
from clpipe.base.validation import check_argument_types
from clpipe.batch.clips import parse_bit_rate, parse_rate, take_clip_options
from clpipe.batch.execution import ExecutionOptions, parse_failures
from clpipe.batch.images import Images
from clpipe.batch.session import Run
from clpipe.chain.drawing import plain_settings
from clpipe.chain.formats import format_named
from clpipe.chain.options import (
    DEFAULT_PATCHES,
    OPTIONS,
    Gaps,
    Moments,
    RedoName,
    Transfer,
    check_option,
)
from clpipe.chain.python_words import errors_in_python
from clpipe.chain.rendition import parse_bracket
from clpipe.chain.request import Request
from clpipe.images.video import Codec
from clpipe.inputs.find import parse_shard
from clpipe.inputs.series import split_series
from clpipe.outputs.existing import Redo
from clpipe.outputs.patches import Patches

# Conversions of option values.
CONVERTERS: dict[str, Callable[[Any], Any]] = {
    "output": lambda output: path_of(str(output)),
    "format": lambda names: tuple(map(format_named, names)),
    "bracket": parse_bracket,
    "bit_rate": lambda rate: parse_bit_rate(str(rate)),
    "fps": lambda rate: parse_rate(str(rate)),
    "poses": partial(local_path, "poses"),
    "redo": Redo,
    "shard": parse_shard,
    "max_failures": lambda limit: parse_failures(str(limit)),
    "memory": lambda size: parse_size(str(size)),
    "trace": partial(local_path, "trace"),
}
# Options whose fields in Request, Images and ExecutionOptions have other names.
FIELD_NAMES = {"format": "formats", "webdataset": "per_tar", "device": "devices", "jobs": "threads"}

Texts = str | Path | Sequence[str | Path]  # one text or several


@errors_in_python()
@check_argument_types
def run(
    inputs: Texts,
    output: str | Path,
    config: Texts | None = None,
    *,
    camera: Texts | Mapping[str, Any] | None = None,
    iso: float | str | Sequence[float] | Mapping[str, Any] | None = None,
    start_at: str | None = None,
    until: str | None = None,
    stage_files: Texts | None = None,
    format: Texts | None = None,
    keep: Texts | None = None,
    carry: Texts | None = None,
    truth: Texts | None = None,
    truth_at: Moments | None = None,
    sequence: bool | None = None,
    codec: Codec | None = None,
    bit_depth: int | None = None,
    crf: int | None = None,
    bit_rate: float | str | None = None,
    fps: float | str | None = None,
    gaps: Gaps | None = None,
    decoded: bool | None = None,
    frames: int | None = None,
    bracket: Sequence[float] | None = None,
    patch: int | Patches | None = None,
    exclude: Texts | None = None,
    poses: str | Path | None = None,
    repeat: int | None = None,
    layer: str | None = None,
    transfer: Transfer | None = None,
    max_pixels: int | None = None,
    redo: RedoName | None = None,
    webdataset: int | None = None,
    max_failures: int | str | None = None,
    shard: str | None = None,
    device: str | int | Sequence[str | int] | None = None,
    memory: int | str | None = None,
    jobs: int | None = None,
    processes: int | None = None,
    dask: str | None = None,
    trace: str | Path | None = None,
    **settings: Any,
) -> Run:
    """Process images with a chain and write the results, like ``clpipe run``.

    Arguments that accept several values also accept a single one. ``camera`` and ``iso`` may be
    random draws, such as ``{"log_uniform": [100, 6400]}``. ``patch`` may be
    ``Patches(128, per_image=4)``.

    >>> import tempfile
    >>> import OpenImageIO as oiio
    >>> import clpipe
    >>> folder = tempfile.TemporaryDirectory()
    >>> render = oiio.ImageBufAlgo.fill((0.2, 0.3, 0.4), oiio.ROI(0, 32, 0, 24, 0, 1, 0, 3))
    >>> _ = render.write(f"{folder.name}/a.exr")
    >>> out = f"{folder.name}/out"
    >>> made = clpipe.run(f"{folder.name}/a.exr", out, iso=1600, truth="clean", device="numpy")
    >>> for outcome in made:
    ...     print(outcome.job.path.name, outcome.status, outcome.outputs)
    a.exr done ('a.jpg', 'a.json', 'a.truth_clean.jpg', 'a.truth_clean.json')
    >>> made.summary.counts
    {'done': 1, 'skipped': 0, 'left out': 0, 'failed': 0}
    >>> folder.cleanup()

    Args:
        inputs: files, directories, globs, URLs and manifests (.csv, .jsonl).
        output: the output directory. It is created if it does not exist. NAME.mp4 or NAME.mkv
            writes the frames of one sequence as a clip.
        config: a built-in configuration or a TOML file. The built-in ones are brooks2019,
            canon-5d2-jpeg, canon-5d3-jpeg, default, nikon-d800-jpeg, paper, syb3r, training,
            unprocess, video. If you name several, each overrides those before it, and one with
            stages replaces their development.
        camera: a built-in camera, by name or model, or a profile (.toml). With several, each
            camera's pictures go to OUT/CAMERA. None is sony-a7r2.
        iso: the ISO, several, or a range. Noise and denoising depend on it. With several, such as
            100,800, each ISO's pictures go to a directory such as OUT/iso800. With a range, such as
            100..6400, each image draws one, and every octave is equally likely. In Python,
            (100, 6400) is a range. None is 100.
        start_at: the first stage to run. Inputs are then images of the kind that it reads, such as
            kept images or mosaics.
        until: the last stage to run.
        stage_files: a Python file that defines further stages.
        format: the format of the pictures, or dng for the raw that quantize makes. npy holds
            float16, and DN as uint16. It also makes the images of ``keep`` .npy. mp4 and mkv write
            each sequence as a clip. The choices are "jpg", "png", "png16", "tif", "tif16", "tif32",
            "exr", "exr16", "npy", "dng", "mp4", "mkv". None is jpg; exr, or npy for patches, if
            ``until`` ends the chain earlier.
        keep: a stage whose image is also written, or all. It is a float EXR.
        carry: a layer to warp with the picture. It has depth, normals, flow or object numbers, in
            the image's own file or in one next to it, and is written to OUT/NAME.carried.exr. KIND
            is needed if the name does not imply it: depth, label, normal, flow, colour or png. png
            is depth in metres or object numbers. It also writes a PNG with 16 bits,
            OUT/NAME.LAYER.png, with depth in millimetres. FILE is the path from the image's
            directory, as in 'Depth=../depth/{name}.exr'. None is {name}_LAYER.exr or similar.
        truth: write the picture without noise (development) and denoising (clean), the clean
            mosaic (mosaic), its noise variance (variance), spectral light (xyz) or (srgb), or
            uniform (iid) or intensity-dependent (intensity) noise. The light is that of a spectral
            render before the sensor, in CIE XYZ or linear sRGB. The noise of iid and intensity is
            added to the clean picture. It is independent and as strong as the picture's. These two
            also write the ground truth from which they are made. The choices are "development",
            "clean", "mosaic", "variance", "xyz", "srgb", "iid", "intensity".
        truth_at: the moment of an exposure of several files whose pose and layers are written with
            the picture. Use all to write also the layers of its start and end. Use rows to take
            each row of the layers from the file in the middle of the row's exposure. The choices
            are "start", "middle", "end", "all", "rows". None is middle.
        sequence: process the frames of each directory as a sequence, in the order of the numbers in
            their names. A draw has one value for each sequence, unless it is a drift. Automatic
            exposure and white balance follow the frames with the loops of [control]. OUT/run.csv
            lists the settings of all frames.
        codec: the codec of clips. ffv1 is lossless, and needs mkv. The choices are "h264", "h265",
            "ffv1". None is h264.
        bit_depth: the bits per sample of clips, 8 or 10. None is 8.
        crf: the constant rate factor of clips. Smaller is better, and 51 is worst. None is 18.
        bit_rate: the mean bit rate of clips in bits per second, such as 8M, instead of ``crf``.
        fps: the frames per second of clips, such as 30000/1001. None is that of the frames' times,
            or 24.
        gaps: what a clip shows at the places of missing frames: hold shows the frame before, black
            a black one, and cut nothing, so that the clip is shorter. The choices are "hold",
            "black", "cut". None is hold.
        decoded: also decode each clip, and write its frames to OUT/CLIP.decoded/NAME.png.
        frames: the number of frames of a burst. Each frame has its own noise, and the burst its
            ground truth.
        bracket: the exposures of a bracket, in EV relative to the exposure that is set. Each
            exposure has its own noise, frames and ground truth.
        patch: the side of square patches in px. They are written instead of pictures, as
            OUT/NAME_0000.jpg and so on. A patch has the same values as the picture there. Images of
            ``keep`` are .npy.
        exclude: a pattern of files and directories to skip. In directories and globs, it matches
            names and paths relative to the input directory.
        poses: a file with the camera and pose of each render. This is a cameras.json, a
            transforms.json (NeRF, nerfstudio), or a directory with COLMAP's text model. The cameras
            and poses of the pictures are written to OUT/cameras.json, OUT/transforms.json and
            OUT/sparse/0, see clpipe poses.
        repeat: the number of pictures of each image, with their own noise and draws. They are
            called OUT/NAME_0000.jpg and so on.
        layer: the layer or part of an EXR that is the picture.
        transfer: the transfer curve of renders with integer samples (PNG, TIFF and others). The
            choices are "srgb", "linear".
        max_pixels: the most pixels of an image. Larger images are rejected before memory is
            allocated. None is 200000000.
        redo: recompute no existing picture (missing), those of another version of clpipe (old),
            also damaged ones (damaged), or all, even files of other programs (all). Pictures that
            are missing or whose request has changed are always made. damaged reads all files. The
            choices are "missing", "old", "damaged", "all". None is old.
        webdataset: the number of images per tar for WebDataset, OUT/000000.tar and so on.
        max_failures: the most images of this run that may fail, as a number or a percentage. If
            more fail, the run stops and has exit status 1. None is no limit.
        shard: the part of the images to make, such as 2/8, for job arrays.
        device: an index or part of a name from 'clpipe devices', or numpy. None is the first GPU
            and all GPUs like it, else the CPU.
        memory: the memory of a device that clpipe may use, such as 2G. Larger images are processed
            in tiles. None is what is free.
        jobs: the number of threads that decode, and of threads that encode. None is one per
            processor.
        processes: the number of processes that share the work. Each has a part of the processors
            and devices. None is as many as the number and size of the images justify.
        dask: the address of a Dask scheduler, such as tcp://HOST:8786, whose workers do the work.
            They must see the same files.
        trace: a file for a timeline of the run, for Perfetto or chrome://tracing.
        **settings: any value of a configuration file, which overrides ``config``:
            ``seed=1``, ``denoise={"method": "mean"}``.

    Returns:
        A :class:`Run`. The run starts when you iterate over it, and yields an :class:`Outcome`
        for each image, in any order.

    Raises:
        RequestError: a name or value is not allowed, an input does not exist, or a result would
            overwrite an input. If one image fails, its outcome says so, and the run continues.
    """
    options = dict(locals())
    for name, field in (("augment", "augment"), ("patches_per_image", "per_image")):
        if name in settings:
            raise RequestError(
                f"found {name} {settings[name]!r}; set it together with the size, as in "
                f"patch=clpipe.Patches(64, {field}={settings[name]!r})"
            )
    if isinstance(patch, Patches):
        options["patch"], options["augment"] = patch.size, patch.augment
        options["patches_per_image"] = patch.per_image
    return run_of(options, options.pop("settings"))


def run_of(
    options: Mapping[str, Any],
    settings: Mapping[str, Any],
    arguments: Sequence[str] = (),
    echo: Callable[[bytes], None] | None = None,
) -> Run:
    """Return the run for options. :func:`run` and the command ``clpipe run`` both call this.

    Args:
        options: arguments of :func:`run`, by the names of :data:`OPTIONS`. An ISO and a bracket may
            be texts with commas. None is an option that is not set.
        settings: values of a configuration file, nested.
        arguments: as for :class:`Run`.
        echo: as for :class:`Run`.

    Raises:
        RequestError: as for :func:`run`.
    """
    set_options = {name: value for name, value in options.items() if value is not None}
    if not str(set_options["output"]):
        raise RequestError("output: found an empty path; name a directory")
    series_options: dict[str, Any] = {
        name: set_options.pop(name) for name in ("camera", "iso") if name in set_options
    }
    series, values = split_series(plain_settings({**settings, **series_options}))
    for name, value in set_options.items():
        converted = as_texts(value) if OPTIONS[name].type_ is list else value
        set_options[name] = CONVERTERS[name](converted) if name in CONVERTERS else converted
        check_option(name, set_options[name])
    if "patch" in set_options:
        set_options.setdefault("patches_per_image", DEFAULT_PATCHES)
    elif ignored := [name for name in ("patches_per_image", "augment") if set_options.get(name)]:
        raise RequestError(
            f"--{ignored[0].replace('_', '-')}: this option needs patches; add --patch SIZE"
        )
    clips = take_clip_options(set_options)
    dask = set_options.pop("dask", None)
    set_options = {FIELD_NAMES.get(name, name): value for name, value in set_options.items()}
    execution = ExecutionOptions(**_fields_of(ExecutionOptions, set_options))
    images = Images(**_fields_of(Images, set_options), series=series, clips=clips)
    return Run(
        Request.from_options(values=values, **set_options), images, execution, dask, arguments, echo
    )


def _fields_of(class_: type[ExecutionOptions | Images], values: dict[str, Any]) -> dict[str, Any]:
    """Remove the values of a dataclass's fields from a dictionary, and return them."""
    return {each.name: values.pop(each.name) for each in fields(class_) if each.name in values}
