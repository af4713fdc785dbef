"""Keywords of the Python API: the tables and keys of a configuration, with their types.

Written by ``tools/run pages keywords`` from the stages that clpipe has. Numbers may be NumPy's, and
a value may be a draw, such as ``{"uniform": [0, 1]}``.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import numpy as np

Draw = Mapping[str, Any]
Flag = bool | Draw
Number = float | np.floating[Any] | np.integer[Any] | Draw
Whole = int | np.integer[Any] | Draw
Text = str | Draw
Several = Sequence[Any] | np.ndarray[Any, Any] | Draw

class Projection(TypedDict, total=False):
    method: Draw | Literal["none", "kannala_brandt", "unified", "double_sphere", "f_theta"]
    cx: Number
    cy: Number
    width: Whole
    height: Whole
    field_of_view: Number
    source: Draw | Literal["auto", "map"]
    face_angle: Number
    views: Text
    filter: Draw | Literal["bicubic", "lanczos3"]
    fx: Number
    fy: Number
    k1: Number
    k2: Number
    k3: Number
    k4: Number
    alpha: Number
    beta: Number
    xi: Number
    k5: Number

class Shutter(TypedDict, total=False):
    method: Draw | Literal["rows"]
    subframes: Whole
    exposure_time: Number
    line_time: Number
    frame_time: Number
    flicker_depth: Number
    flicker_frequency: Number
    flicker_phase: Number
    flicker_duty: Number
    flicker_layer: Text

class Defocus(TypedDict, total=False):
    method: Draw | Literal["none", "thin_lens"]
    layer: Text
    fx: Number
    focal_length: Number
    sensor_width: Number
    f_number: Number
    focus_distance: Number
    depth_scale: Number
    pixel_pitch: Number
    blades: Whole
    max_radius: Whole

class MotionBlur(TypedDict, total=False):
    method: Draw | Literal["linear", "perspective"]
    length: Number
    angle: Number
    rotation: Number
    fx: Number
    cx: Number
    cy: Number
    focal_length: Number
    sensor_width: Number

class Distortion(TypedDict, total=False):
    method: Draw | Literal["lens", "none", "brown_conrady", "fisheye", "poly3", "poly5", "ptlens"]
    cx: Number
    cy: Number
    fit: Flag
    filter: Draw | Literal["bicubic", "lanczos3"]
    kr: Number
    kb: Number
    vr: Number
    cr: Number
    br: Number
    vb: Number
    cb: Number
    bb: Number
    fx: Number
    focal_length: Number
    sensor_width: Number
    fy: Number
    k1: Number
    k2: Number
    k3: Number
    k4: Number
    k5: Number
    k6: Number
    p1: Number
    p2: Number
    s1: Number
    s2: Number
    s3: Number
    s4: Number
    unit: Number
    a: Number
    b: Number
    c: Number

class Vignetting(TypedDict, total=False):
    method: Draw | Literal["lens", "none", "pa", "cosine_fourth"]
    k1: Number
    k2: Number
    k3: Number
    cx: Number
    cy: Number
    fx: Number
    focal_length: Number
    sensor_width: Number

class InverseColorMatrix(TypedDict, total=False):
    method: Draw | Literal["camera", "given", "none"]
    matrix: Several

class Glare(TypedDict, total=False):
    method: Draw | Literal["none", "veil"]
    share: Number

class OpticalBlur(TypedDict, total=False):
    method: Draw | Literal["lens", "none"]
    sigma: Number
    f_number: Number
    pixel_pitch: Number
    low_pass: Number
    pixel_area: Number
    corner: Number
    psf: Text

class Exposure(TypedDict, total=False):
    method: Draw | Literal["gain", "auto", "photometric", "radiometric"]
    ev: Number
    headroom: Number
    sets_time: Flag
    rule: Draw | Literal["log_average", "percentile"]
    target: Number
    metering: Draw | Literal["average", "centre_weighted", "spot"]
    percentile: Number
    delta: Number
    min_ev: Number
    max_ev: Number
    exposure_time: Number
    f_number: Number
    q: Number
    scale: Number
    pixel_pitch: Number
    quantum_efficiency: Number

class Mosaic(TypedDict, total=False):
    method: Draw | Literal["bayer", "array"]
    pattern: Draw | Literal["RGGB", "BGGR", "GRBG", "GBRG"]
    array: Text

class InverseWhiteBalance(TypedDict, total=False):
    method: Draw | Literal["gains"]
    red_gain: Number
    blue_gain: Number

class Crosstalk(TypedDict, total=False):
    method: Draw | Literal["neighbours"]
    share: Number

class Prnu(TypedDict, total=False):
    method: Draw | Literal["gaussian"]
    sigma: Number

class DefectPixels(TypedDict, total=False):
    method: Draw | Literal["random"]
    hot_share: Number
    hot_level: Number
    dead_share: Number

class Blooming(TypedDict, total=False):
    method: Draw | Literal["none", "column"]
    full_signal: Number
    spill: Number

class SensorNoise(TypedDict, total=False):
    method: (
        Draw
        | Literal[
            "skewed_gaussian",
            "gaussian",
            "poisson",
            "dual_gain",
            "split_pixel",
            "split_dual_gain",
            "staggered",
            "none",
        ]
    )
    a: Number
    b: Number
    system_gain: Number
    read_noise: Number
    adc_noise: Number
    chi: Number
    theta: Number
    b_before: Number
    b_after: Number
    p0: Number
    full_well: Number
    tukey_lambda: Number
    ratio: Number
    later_noise: Number
    part: Whole
    crosstalk: Number
    light_ratio: Number
    count: Whole
    full_signal: Number

class DarkCurrent(TypedDict, total=False):
    method: Draw | Literal["thermal"]
    exposure_time: Number
    temperature: Number
    current: Number
    reference_temperature: Number
    doubling: Number
    spread: Number
    per_electron: Number

class RandomTelegraph(TypedDict, total=False):
    method: Draw | Literal["two_levels"]
    share: Number
    amplitude: Number

class Dsnu(TypedDict, total=False):
    method: Draw | Literal["gaussian"]
    sigma: Number

class DarkShading(TypedDict, total=False):
    method: Draw | Literal["smooth", "file"]
    slope: Number
    offset: Number
    length: Number
    slope_file: Text
    offset_file: Text
    block: Number
    unit: Number

class RowNoise(TypedDict, total=False):
    method: Draw | Literal["gaussian"]
    sigma: Number

class ColumnNoise(TypedDict, total=False):
    method: Draw | Literal["gaussian"]
    sigma: Number

class Banding(TypedDict, total=False):
    method: Draw | Literal["sine"]
    amplitude: Number
    period: Number

class BlackLevelError(TypedDict, total=False):
    method: Draw | Literal["offsets"]
    sigma: Number
    bias: Several
    offset: Number

class Quantize(TypedDict, total=False):
    method: Draw | Literal["linear", "pwl"]
    bits: Whole
    black_level: Number
    white_level: Number
    result_bits: Whole
    knots: Several

class Normalize(TypedDict, total=False):
    method: Draw | Literal["linear", "pwl"]
    black_level: Number
    white_level: Number
    knots: Several

class WhiteBalance(TypedDict, total=False):
    method: Draw | Literal["as_shot", "gray_world", "white_patch", "gains", "none"]
    red_gain: Number
    blue_gain: Number
    limit: Flag
    percentile: Number
    clip: Number

class Demosaic(TypedDict, total=False):
    method: (
        Draw
        | Literal[
            "bounded",
            "edge_directed_median",
            "edge_directed",
            "median",
            "bilinear",
            "malvar2004",
            "menon2007",
            "linear_mmse",
            "directional_mmse",
            "gray",
        ]
    )
    noise: Number
    offset: Number
    classifier: Draw | Literal["hamilton_adams", "laroche_prescott", "hibbard"]
    size: Draw | Literal[3, 5]

class Denoise(TypedDict, total=False):
    method: Draw | Literal["biweight", "bilateral", "non_local_means", "median", "mean"]
    luma_strength: Number
    chroma_strength: Number
    luma_noise: Number
    chroma_noise: Number
    grain: Number
    chroma_scale: Whole
    offset: Number
    luma_size: Whole
    chroma_size: Whole
    spatial_sigma: Number
    guide: Draw | Literal["smooth", "image"]

class ColorMatrix(TypedDict, total=False):
    method: Draw | Literal["as_shot", "camera", "given", "none"]
    matrix: Several

class Sharpen(TypedDict, total=False):
    method: Draw | Literal["unsharp", "none"]
    radius: Number
    amount: Number
    threshold: Number
    limit: Number
    offset: Number

class ToneCurve(TypedDict, total=False):
    method: Draw | Literal["standard", "neutral", "camera_raw", "linear", "file"]
    toe: Number
    shoulder: Number
    saturation: Number
    headroom: Number
    path: Text

class Gamma(TypedDict, total=False):
    method: Draw | Literal["srgb", "power"]
    exponent: Number

class PictureNoise(TypedDict, total=False):
    method: Draw | Literal["none", "iid_gaussian", "intensity_dependent"]
    match: Draw | Literal["picture", "flat", "halved"]
    correlated: Flag
    jpeg: Flag
    measured: Text
    correlation: Several
    sigma: Several

class InverseGamma(TypedDict, total=False):
    method: Draw | Literal["srgb", "power"]
    exponent: Number

class InverseToneCurve(TypedDict, total=False):
    method: Draw | Literal["standard", "neutral", "camera_raw", "linear", "file"]
    toe: Number
    shoulder: Number
    saturation: Number
    path: Text

class MosaicDenoise(TypedDict, total=False):
    method: Draw | Literal["non_local_means"]
    size: Whole
    strength: Number
    a: Number
    b: Number

class Remosaic(TypedDict, total=False):
    method: Draw | Literal["binning", "linear_mmse"]
    pattern: Draw | Literal["RGGB", "BGGR", "GRBG", "GBRG"]

class Resize(TypedDict, total=False):
    method: Draw | Literal["area", "lanczos3"]
    scale: Number

class RestoreHighlights(TypedDict, total=False):
    method: Draw | Literal["brooks2019"]
    red_gain: Number
    blue_gain: Number

class SpectralResponse(TypedDict, total=False):
    method: Draw | Literal["camera", "xyz", "srgb"]

class TemporalDenoise(TypedDict, total=False):
    method: Draw | Literal["recursive", "block_matching", "flow"]
    frames: Number
    threshold: Number
    radius: Whole
    layer: Text

class Encoding(TypedDict, total=False):
    jpeg_quality: Whole
    jpeg_subsampling: Draw | Literal["4:4:4", "4:2:2", "4:2:0"]
    jpeg_progressive: Flag
    date: Text
    png_compression: Whole

class RenderCamera(TypedDict, total=False):
    exposure_time: Number
    focal_length: Number
    sensor_width: Number
    fx: Number
    fy: Number
    cx: Number
    cy: Number
    camera_angle_x: Number
    wavelengths: Several
    illuminant: Text
    rotation: Several
    translation: Several
    motion: Several

class Control(TypedDict, total=False):
    delay: Whole
    smoothing: Number
    speed: Number
    hysteresis: Number
    iso_max: Number
    iso_min: Number
    time_max: Number
    mains: Number

class Keywords(TypedDict, total=False):
    camera: Text
    iso: Number | Text | tuple[float, float]
    lens: Text
    focal_length: Number
    aperture: Number
    focus_distance: Number
    seed: Whole
    noise_key: Text
    dump: Text
    stages: Sequence[str]
    skip: Sequence[str]
    projection: Projection
    shutter: Shutter
    defocus: Defocus
    motion_blur: MotionBlur
    distortion: Distortion
    vignetting: Vignetting
    inverse_color_matrix: InverseColorMatrix
    glare: Glare
    optical_blur: OpticalBlur
    exposure: Exposure
    mosaic: Mosaic
    inverse_white_balance: InverseWhiteBalance
    crosstalk: Crosstalk
    prnu: Prnu
    defect_pixels: DefectPixels
    blooming: Blooming
    sensor_noise: SensorNoise
    dark_current: DarkCurrent
    random_telegraph: RandomTelegraph
    dsnu: Dsnu
    dark_shading: DarkShading
    row_noise: RowNoise
    column_noise: ColumnNoise
    banding: Banding
    black_level_error: BlackLevelError
    quantize: Quantize
    normalize: Normalize
    white_balance: WhiteBalance
    demosaic: Demosaic
    denoise: Denoise
    color_matrix: ColorMatrix
    sharpen: Sharpen
    tone_curve: ToneCurve
    gamma: Gamma
    picture_noise: PictureNoise
    inverse_gamma: InverseGamma
    inverse_tone_curve: InverseToneCurve
    mosaic_denoise: MosaicDenoise
    remosaic: Remosaic
    resize: Resize
    restore_highlights: RestoreHighlights
    spectral_response: SpectralResponse
    temporal_denoise: TemporalDenoise
    output: Encoding
    render: RenderCamera
    control: Control
