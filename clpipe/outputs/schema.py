"""Models of the files that a run writes, from which their JSON Schemas are made.

The values are built where they are computed. Tests validate files of all kinds of runs.
"""

from typing import Annotated, Any, Literal, NotRequired, get_type_hints

from pydantic import Field
from typing_extensions import TypedDict  # pydantic needs it for Python 3.11

from clpipe.chain.camera_info import CameraInfo
from clpipe.reference.intrinsics import Intrinsics

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Number = Annotated[Literal[1], Field(description="The number of the format.")]
Row = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Values = dict[str, Any]


class Output(TypedDict):
    """A file that was written."""

    name: str
    size: Count
    sha256: Sha256


class Input(TypedDict):
    """A file that was read, relative to the folder of the image, with its time in ns."""

    file: str
    size: Count
    modified: int
    sha256: Sha256


class LayerInput(Input):
    """The file of a layer, and how the layer was warped."""

    layer: NotRequired[str]
    kind: NotRequired[str]
    resampling: NotRequired[str]
    channels: NotRequired[list[str]]
    moment: NotRequired[str]


class Step(TypedDict):
    """A step. Parameters that are missing have the default of the method, as in clpipe stages."""

    name: str
    stage: NotRequired[Annotated[str, Field(description="The stage, if the name is another.")]]
    method: str
    parameters: NotRequired[Values]
    estimates: NotRequired[dict[str, float]]


class Pose(TypedDict):
    """A pose: x_cam = R X + t, OpenCV's axes."""

    R: tuple[Row, Row, Row]
    t: Row


class Response(TypedDict):
    """The response to greys: codes of x = i / 255, and the least x of each code i / 255."""

    table: Annotated[list[Share], Field(min_length=256, max_length=256)]
    inverse: Annotated[list[Share], Field(min_length=256, max_length=256)]


class Photometry(TypedDict):
    """How a render's light became the picture's."""

    ev: float
    gain: float
    exposure_time: Annotated[float | None, Field(description="s")]
    f_number: float | None
    iso: float
    gains: dict[Literal["light", "applied"], Row]
    falloff: Values | None
    response: NotRequired[Response | None]


# CameraInfo with the projection matrix, as its method record returns it.
_CAMERA: Any = {**get_type_hints(CameraInfo), "p": tuple[Row4, Row4, Row4] | None}
CameraRecord: Any = TypedDict("CameraRecord", _CAMERA)  # type: ignore[misc]


class Request(TypedDict):
    """The request. Fields that are missing have their defaults."""

    config: NotRequired[Values]
    options: NotRequired[Values]
    image: NotRequired[Values]
    start_at: NotRequired[str]
    until: NotRequired[str]
    stage_files: NotRequired[list[str]]
    image_name: NotRequired[str]
    layer: NotRequired[str]
    transfer: NotRequired[str]
    formats: NotRequired[list[str]]
    keep: NotRequired[list[str]]
    patch: NotRequired[int]
    patches_per_image: NotRequired[int | str]
    augment: NotRequired[bool]
    carry: NotRequired[list[str]]
    truth_at: NotRequired[str]
    files: dict[str, str | None]


class Shared(TypedDict):
    """DIGEST.run: what the pictures of a run share."""

    format: Number
    clpipe: str
    device: Annotated[Values, Field(description="The device, its driver and its target.")]
    versions: dict[str, str]
    response: NotRequired[Response | None]


class Sidecar(TypedDict):
    """NAME.json: everything that is needed to make a picture again."""

    clpipe: Annotated[str, Field(description="The version of clpipe.")]
    format: Number
    input: Annotated[str, Field(description="The image's path or URL.")]
    input_size: Count
    input_modified: Annotated[int, Field(description="ns since 1970")]
    sha256: Sha256
    subframes: NotRequired[list[Input]]
    panorama: NotRequired[Values]
    layer: str
    part: int
    name: Annotated[str, Field(description="The path of the outputs, without extension.")]
    picture: Annotated[str, Field(description="What follows the name, such as .truth.")]
    role: str
    ev: Annotated[float | None, Field(description="The EV in a bracket.")]
    frame: Annotated[int | None, Field(description="The number in a burst.")]
    frames: int | None
    image_key: str
    noise_key: str
    seed: int
    width: Count
    height: Count
    camera: str
    iso: float
    place: NotRequired[Annotated[Values, Field(description="The place in a sequence.")]]
    lens: NotRequired[str]
    output: Values
    intrinsics: Intrinsics | None
    camera_info: CameraRecord
    pose: Pose | None
    motion: NotRequired[Values]
    row_times: NotRequired[Values]
    photometry: Photometry | None
    noise: Values | None
    starts_on: str
    raw: NotRequired[Values]
    stages: list[Step]
    facts: NotRequired[Annotated[Values, Field(description="The camera of patches.")]]
    patches: NotRequired[Annotated[list[Values], Field(description="The places of patches.")]]
    clipped: Share | None
    outputs: list[Output]
    carried: NotRequired[list[LayerInput]]
    depth: NotRequired[list[LayerInput]]
    flow: NotRequired[list[LayerInput]]
    overscan: NotRequired[dict[Literal["left", "top", "right", "bottom"], int]]
    warnings: list[str]
    program: Annotated[Sha256, Field(description="A digest of clpipe and its libraries.")]
    request: Request
    run: Annotated[Sha256, Field(description="The SHA-256 of the file with what its run shares.")]
    sidecar_sha256: NotRequired[
        Annotated[Sha256, Field(description="The digest of all lines before.")]
    ]
    index: NotRequired[Annotated[float, Field(description="In a clip: the frame's place.")]]
    time: NotRequired[Annotated[float | None, Field(description="In a clip: its time, s.")]]
    clip: NotRequired[Annotated[Values, Field(description="The clip.")]]


class PatchSidecar(TypedDict):
    """The sidecar of one patch in a tar."""

    clpipe: str
    format: Number
    image_key: str
    noise_key: str
    iso: float
    noise: Values | None
    camera: str
    seed: int
    cfa: NotRequired[str]
    black_level: NotRequired[float]
    white_level: NotRequired[float]
    gains: NotRequired[Row]
    xyz_to_camera: NotRequired[tuple[Row, Row, Row]]
    place: Annotated[tuple[int, int], Field(description="The left and upper edge, px.")]
    turn: int
    sidecar_sha256: Sha256


class View(TypedDict):
    """A picture in cameras.json."""

    file: str
    width: Count
    height: Count
    K: tuple[Row, Row, Row]
    R: NotRequired[tuple[Row, Row, Row]]
    t: NotRequired[Row]
    model: Annotated[str, Field(description="COLMAP's model.")]
    distortion: dict[str, float]
    motion: NotRequired[Values]
    photometry: NotRequired[Annotated[Values, Field(description="response is an index.")]]


class Cameras(TypedDict):
    """cameras.json: the cameras of the pictures."""

    format: Number
    note: str
    responses: NotRequired[list[Response]]
    views: list[View]


class LogStart(TypedDict):
    """The first line of a run in run.jsonl."""

    event: Literal["start"]
    at: str
    format: Number
    clpipe: str
    attempt: int
    arguments: list[str]
    images: int
    tars: int
    shard: str
    host: str
    pid: int


class LogImage(TypedDict):
    """The line of an image in run.jsonl."""

    event: Literal["image"]
    at: str
    input: str
    name: str
    stem: str
    status: str
    host: str
    pid: int
    device: str | None
    layer: str
    part: int
    megapixels: float
    fetch_seconds: float
    decode_seconds: float
    device_seconds: float
    encode_seconds: float
    outputs: list[str]
    warnings: list[str]
    clipped: Share
    error: str | None
    error_class: str | None
    reason: NotRequired[str]


class LogEnd(TypedDict):
    """The last line of a run in run.jsonl."""

    event: Literal["end"]
    at: str
    images: int
    done: int
    skipped: int
    left_out: int
    failed: int
    interrupted: bool
    gave_up: str | None
    of_another_program: int
    megapixels: float
    seconds: float
    peak_memory: int
    fetch_seconds: float
    decode_seconds: float
    device_seconds: float
    encode_seconds: float


# The model of each kind of file; that of run.jsonl describes a line.
FILES: dict[str, Any] = {
    "sidecar": Sidecar,
    "patch": PatchSidecar,
    "run": Shared,
    "cameras": Cameras,
    "log": LogStart | LogImage | LogEnd,
}
