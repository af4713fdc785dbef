"""The options of a run, each with its name, type, range, choices, default and help.

The options of ``clpipe run``, the checks and documentation of :func:`clpipe.run`, and the options
that other commands share are all derived from these keys.
"""

from pathlib import Path
from typing import Any, Literal, get_args

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.files import built_in_configs
from clpipe.chain.formats import ALL_FORMATS, CLIP_FORMATS
from clpipe.chain.identity import MAX_FRAMES
from clpipe.chain.keys import CODE, KEYS, Key
from clpipe.chain.rendition import BASELINES, CLEAN, TRUTHS
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, MAX_PIXELS
from clpipe.images.video import DEFAULT_CRF, Codec
from clpipe.reference.carried import RESAMPLING

Moments = Literal["start", "middle", "end", "all", "rows"]
Transfer = Literal["srgb", "linear"]
Gaps = Literal["hold", "black", "cut"]
RedoName = Literal["missing", "old", "damaged", "all"]

MAX_PATCHES = 9999  # patches per image; file names have four digits
DEFAULT_PATCHES = 16  # patches per image

DEVICE = Key(
    "device",
    str,
    "An index or part of a name from 'clpipe devices', or numpy.",
    "SEL",
    "the first GPU, else the CPU",
)

TRUTH = Key(
    "truth",
    list,
    "Write the picture without noise (development), without noise and denoising (clean), the clean "
    "mosaic (mosaic), or its noise variance (variance).",
    default_text=CLEAN,
    choices=TRUTHS,
)

FORMAT = Key(
    "format",
    list,
    "The format of the pictures, or dng for the raw that quantize makes. npy holds float16, and DN "
    "as uint16. It also makes the images of --keep .npy.",
    default_text="jpg; exr, or npy for patches, if --until ends the chain earlier",
    choices=ALL_FORMATS,
)

_ALL = (
    Key("inputs", list, "Files, directories, globs, URLs and manifests (.csv, .jsonl).", "INPUT"),
    Key(
        "output",
        Path,
        "The output directory. It is created if it does not exist. NAME.mp4 or NAME.mkv writes the "
        "frames of one sequence as a clip.",
        "OUT",
    ),
    Key(
        "config",
        list,
        "A built-in configuration or a TOML file. The built-in ones are "
        f"{', '.join(built_in_configs())}. If you name several, each overrides those before it, "
        "and one with stages replaces their development.",
        "NAME|FILE",
    ),
    KEYS["camera"]._replace(
        type_=list,
        text=f"{KEYS['camera'].text} With several, each camera's pictures go to OUT/CAMERA.",
    ),
    KEYS["iso"]._replace(
        type_=str,
        text=f"{KEYS['iso'].text} With several, each ISO's pictures go to a directory such as "
        "OUT/iso800.",
        metavar="ISO,ISO,...",
    ),
    Key(
        "start_at",
        str,
        "The first stage to run. Inputs are then images of the kind that it reads, such as kept "
        "images or mosaics.",
        "STAGE",
    ),
    Key("until", str, "The last stage to run.", "STAGE"),
    KEYS[CODE],
    FORMAT._replace(
        text=f"{FORMAT.text} mp4 and mkv write each sequence as a clip.",
        choices=(*ALL_FORMATS, *CLIP_FORMATS),
    ),
    Key(
        "keep", list, "A stage whose image is also written, or all. It is a float EXR.", "STAGE|all"
    ),
    Key(
        "carry",
        list,
        "A layer to warp with the picture. It has depth, normals, flow or object numbers, in the "
        "image's own file or in one next to it, and is written to OUT/NAME.carried.exr. "
        f"KIND is needed if the name does not imply it: {', '.join(RESAMPLING)} or png. png is "
        "depth in metres or object numbers. It also writes a PNG with 16 bits, OUT/NAME.LAYER.png, "
        "with depth in millimetres. FILE is the path from the image's directory, as in "
        "'Depth=../depth/{name}.exr'.",
        "NAME[:KIND][=FILE]",
        "{name}_LAYER.exr or similar",
    ),
    TRUTH._replace(
        text="Write the picture without noise (development), without noise and denoising (clean), "
        "the clean mosaic (mosaic), its noise variance (variance), or the clean picture with "
        "uniform (iid) or intensity-dependent (intensity) noise. The noise of iid and intensity is "
        "independent and as strong as the picture's. These two also write the ground truth from "
        "which they are made.",
        default_text="",
        choices=(*TRUTHS, *BASELINES),
    ),
    Key(
        "truth_at",
        str,
        "The moment of an exposure of several files whose pose and layers are written with the "
        "picture. Use all to write also the layers of its start and end. Use rows to take each row "
        "of the layers from the file in the middle of the row's exposure.",
        default_text="middle",
        choices=get_args(Moments),
    ),
    Key(
        "sequence",
        bool,
        "Process the frames of each directory as a sequence, in the order of the numbers in their "
        "names. A draw has one value for each sequence, unless it is a drift. Automatic exposure "
        "and white balance follow the frames with the loops of [control]. OUT/run.csv lists the "
        "settings of all frames.",
    ),
    Key(
        "codec",
        str,
        "The codec of clips. ffv1 is lossless, and needs mkv.",
        default_text="h264",
        choices=get_args(Codec),
    ),
    Key("bit_depth", int, "The bits per sample of clips, 8 or 10.", "BITS", "8", above=7, most=10),
    Key(
        "crf",
        int,
        "The constant rate factor of clips. Smaller is better, and 51 is worst.",
        "N",
        f"{DEFAULT_CRF}",
        above=-1,
        most=51,
    ),
    Key(
        "bit_rate",
        str,
        "The mean bit rate of clips in bits per second, such as 8M, instead of --crf.",
        "RATE",
    ),
    Key(
        "fps",
        str,
        "The frames per second of clips, such as 30000/1001.",
        "RATE",
        "that of the frames' times, or 24",
    ),
    Key(
        "gaps",
        str,
        "What a clip shows at the places of missing frames: hold shows the frame before, black a "
        "black one, and cut nothing, so that the clip is shorter.",
        default_text="hold",
        choices=get_args(Gaps),
    ),
    Key(
        "decoded",
        bool,
        "Also decode each clip, and write its frames to OUT/CLIP.decoded/NAME.png.",
    ),
    Key(
        "frames",
        int,
        "The number of frames of a burst. Each frame has its own noise, and the burst its ground "
        "truth.",
        "N",
        above=0,
        most=MAX_FRAMES,
    ),
    Key(
        "bracket",
        str,
        "The exposures of a bracket, in EV relative to the exposure that is set. Each exposure has "
        "its own noise, frames and ground truth.",
        "EV,EV,...",
    ),
    Key(
        "patch",
        int,
        "The side of square patches in px. They are written instead of pictures, as "
        "OUT/NAME_0000.jpg and so on. A patch has the same values as the picture there. Images of "
        "--keep are .npy.",
        "SIZE",
        above=0,
    ),
    Key(
        "patches_per_image",
        int,
        "The number of patches at random places, or grid for adjacent patches that cover the "
        "picture.",
        "N|grid",
        f"{DEFAULT_PATCHES}",
        above=0,
        most=MAX_PATCHES,
    ),
    Key(
        "augment",
        bool,
        "Flip patches and rotate them by multiples of 90 degrees, at random. The CFA pattern "
        "stays the same.",
    ),
    Key(
        "exclude",
        list,
        "A pattern of files and directories to skip. In directories and globs, it matches names "
        "and paths relative to the input directory.",
        "GLOB",
    ),
    Key(
        "poses",
        Path,
        "A file with the camera and pose of each render. This is a cameras.json, a "
        "transforms.json (NeRF, nerfstudio), or a directory with COLMAP's text model. The cameras "
        "and poses of the pictures are written to OUT/cameras.json, OUT/transforms.json and "
        "OUT/sparse/0, see clpipe poses.",
        "FILE",
    ),
    Key("layer", str, "The layer or part of an EXR that is the picture.", "NAME"),
    Key(
        "transfer",
        str,
        "The transfer curve of renders with integer samples (PNG, TIFF and others).",
        choices=get_args(Transfer),
    ),
    Key(
        "max_pixels",
        int,
        "The most pixels of an image. Larger images are rejected before memory is allocated.",
        "N",
        f"{DEFAULT_MAX_PIXELS}",
        above=0,
        most=MAX_PIXELS,
    ),
    Key(
        "redo",
        str,
        "Recompute no existing picture (missing), those of another version of clpipe (old), also "
        "damaged ones (damaged), or all, even files of other programs (all). Pictures that are "
        "missing or whose request has changed are always made. damaged reads all files.",
        default_text="old",
        choices=get_args(RedoName),
    ),
    Key(
        "webdataset",
        int,
        "The number of images per tar for WebDataset, OUT/000000.tar and so on.",
        "N",
        above=0,
        most=10**6,
    ),
    Key(
        "max_failures",
        str,
        "The most images of this run that may fail, as a number or a percentage. If more fail, the "
        "run stops and has exit status 1.",
        "N|N%",
        "no limit",
    ),
    Key("shard", str, "The part of the images to make, such as 2/8, for job arrays.", "I/N"),
    DEVICE._replace(type_=list, default_text="the first GPU and all GPUs like it, else the CPU"),
    Key(
        "memory",
        str,
        "The memory of a device that clpipe may use, such as 2G. Larger images are processed in "
        "tiles.",
        "SIZE",
        "what is free",
    ),
    Key(
        "jobs",
        int,
        "The number of threads that decode, and of threads that encode.",
        "N",
        "one per processor",
        above=0,
        most=1024,
    ),
    Key(
        "processes",
        int,
        "The number of processes that share the work. Each has a part of the processors and "
        "devices.",
        "N",
        "as many as the number and size of the images justify",
        above=0,
        most=1024,
    ),
    Key(
        "dask",
        str,
        "The address of a Dask scheduler, such as tcp://HOST:8786, whose workers do the work. They "
        "must see the same files.",
        "ADDRESS",
    ),
    Key(
        "trace",
        Path,
        "A file for a timeline of the run, for Perfetto or chrome://tracing.",
        "FILE.json",
    ),
)
OPTIONS = {key.name: key for key in _ALL}


def check_option(name: str, value: Any) -> None:
    """Check that a value, which has the type of an option, is in its range or one of its choices.

    Raises:
        RequestError: it is not.
    """
    key = OPTIONS[name]
    if key.type_ is int and isinstance(value, int) and not key.allows(value):
        raise RequestError(f"found {name} {value}; expected {key.allowed}")
    for each in value if key.choices and key.type_ is list else ():
        if each not in key.choices:
            raise RequestError(unknown_name(name, each, key.choices))
