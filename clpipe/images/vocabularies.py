"""What picture files can state, and what becomes of it: one vocabulary for each format."""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from PIL import TiffTags
from PIL.ExifTags import TAGS

from clpipe.base.vocabulary import Vocabulary
from clpipe.images.attributes import PREFIX
from clpipe.images.kinds import AOVS, KIND_NAMES
from clpipe.images.layers import PICTURE_LAYERS
from clpipe.images.tiff import read_directories

# OpenImageIO's names of OpenEXR's attributes, where they differ.
OIIO_NAMES = {
    "expTime": "ExposureTime",
    "aperture": "FNumber",
    "owner": "Copyright",
    "comments": "ImageDescription",
    "capDate": "DateTime",
    "pixelAspectRatio": "PixelAspectRatio",
    "xDensity": "XResolution",
    "envmap": "textureformat",
}
LIBRARY = ("oiio:", "openexr:", PREFIX)  # prefixes of what libraries and clpipe add
OPENEXR = Vocabulary.of(
    "OpenEXR",
    "Standard Attributes (openexr.com, 3.4), the Color Interop Forum and ACES (SMPTE ST 2065-4)",
    {
        "used": {
            "where the pixels are": "displayWindow dataWindow",
            "the channels": "channels name type view multiView",
            "how samples are stored": "lineOrder compression tiles version chunkCount",
            "primaries and white": "chromaticities",
            "white that becomes neutral": "adoptedNeutral",
            "colour space": "colorInteropID oiio:ColorSpace acesImageContainerFlag",
            "exposure time, s": "expTime",
            "focal length, mm": "nominalFocalLength effectiveFocalLength",
            "size of the sensor, mm": "sensorOverallDimensions",
            "projection of a panorama": "envmap",
        },
        "named": {
            "width of a pixel over its height": "pixelAspectRatio",
            "luminance of white, cd/m2": "whiteLuminance",
            "the intended colour rendering": "renderingTransform",
            "the intended look": "lookModTransform",
            "the frame before it was cropped": "originalDataWindow",
        },
        "ignored": {
            "a view's own projection, which --poses states": "screenWindowCenter "
            "screenWindowWidth worldToCamera worldToNDC",
            "the noise depends on --iso": "isoSpeed",
            "the colours are those of the render": "cameraCCTSetting cameraTintSetting "
            "cameraColorBalance",
            "clpipe has its own lens and sensor": "aperture tStop focus lensMake lensModel "
            "lensSerialNumber lensFirmwareVersion pinholeFocalLength entrancePupilOffset "
            "sensorCenterOffset sensorPhotositePitch sensorAcquisitionRectangle shutterAngle",
            "when and where the picture was made": "capDate utcOffset longitude latitude altitude "
            "keyCode timeCode imageCounter reelName framesPerSecond captureRate",
            "who made it, with what": "owner comments cameraMake cameraModel cameraSerialNumber "
            "cameraFirmwareVersion cameraUuid cameraLabel ascFramingDecisionList",
            "size of a print": "xDensity",
            "how a texture is repeated": "wrapmodes",
            "deep pictures, which are rejected": "deepImageState maxSamplesPerPixel",
            "names of labels, which stay numbers": "idManifest",
            "how samples were stored": "dwaCompressionLevel",
        },
    },
)
PNG = Vocabulary.of(
    "PNG",
    "PNG Specification, third edition (W3C 2025), 11",
    {
        "used": {
            "size and samples": "IHDR PLTE IDAT IEND",
            "transparency": "tRNS",
            "primaries and curve": "cICP sRGB cHRM",
            "EXIF, such as orientation": "eXIf",
        },
        "checked": {"the transfer curve, against --transfer": "gAMA"},
        "named": {
            "an ICC profile": "iCCP",
            "luminance of the display": "mDCV cLLI",
            "an animation, of which the first picture is read": "acTL fcTL fdAT",
        },
        "ignored": {
            "the significant bits of a sample, which scale nothing": "sBIT",
            "a background for viewers": "bKGD",
            "size of a print": "pHYs",
            "text and dates": "tEXt zTXt iTXt tIME",
            "helps to quantize colours": "hIST sPLT",
        },
    },
)
TIFF = Vocabulary.of(
    "TIFF",
    "TIFF 6.0 (1992) and its supplements",
    {
        "used": {
            "size": "ImageWidth ImageLength",
            "samples and their type": "BitsPerSample SampleFormat SamplesPerPixel ExtraSamples "
            "PlanarConfiguration ColorMap",
            "how samples are stored": "Compression FillOrder StripOffsets RowsPerStrip "
            "StripByteCounts Predictor TileWidth TileLength TileOffsets TileByteCounts T4Options "
            "T6Options JPEGTables JPEGProc JPEGInterchangeFormat JPEGInterchangeFormatLength "
            "JPEGRestartInterval JPEGLosslessPredictors JPEGPointTransforms JPEGQTables "
            "JPEGDCTables JPEGACTables",
            "how samples become colours": "PhotometricInterpretation YCbCrCoefficients "
            "YCbCrSubSampling YCbCrPositioning",
            "the upper edge": "Orientation",
            "lens, exposure and date": "ExifIFD",
        },
        "named": {
            "the white of its colours": "WhitePoint",
            "the primaries of its colours": "PrimaryChromaticities",
            "its transfer curve": "TransferFunction TransferRange",
            "its levels of black and white": "ReferenceBlackWhite",
            "an ICC profile": "ICCProfile",
            "the curve of its greys": "GrayResponseCurve GrayResponseUnit",
        },
        "ignored": {
            "kind and number of the page": "NewSubfileType SubfileType PageName PageNumber SubIFDs",
            "names, dates and programs": "DocumentName ImageDescription Make Model Software "
            "DateTime Artist HostComputer Copyright XMP IptcNaaInfo PhotoshopInfo GPSInfoIFD",
            "size and place of a print": "XResolution YResolution ResolutionUnit XPosition "
            "YPosition",
            "range of samples, which clpipe measures": "MinSampleValue MaxSampleValue "
            "SMinSampleValue SMaxSampleValue",
            "how it is printed": "Threshholding CellWidth CellLength HalftoneHints InkSet "
            "InkNames NumberOfInks DotRange TargetPrinter",
            "free space in the file": "FreeOffsets FreeByteCounts",
        },
    },
)
JPEG = Vocabulary.of(
    "JPEG",
    "ITU-T T.81 (1992) and T.871 (2011), Exif 2.3 (2010)",
    {
        "used": {
            "samples, with YCbCr as JFIF or Adobe state it": "JFIF Adobe",
            "orientation, lens, exposure and date": "Exif",
        },
        "named": {
            "an ICC profile": "ICC_PROFILE",
            "another colour space than sRGB": "Exif:ColorSpace",
        },
        "ignored": {
            "previews and gain maps: the picture itself is complete": "MPF",
            "text": "XMP Photoshop COM",
        },
    },
)
FIRST_DNG_TAG = 50706
# Numbers of DNG's own tags: those that Pillow knows, and newer ones.
DNG_TAGS = {tag: name for tag, name in TAGS.items() if tag >= FIRST_DNG_TAG} | {
    50933: "ExtraCameraProfiles", 51043: "TimeCodes", 51058: "TStop", 51081: "ReelName",
    51089: "OriginalDefaultFinalSize", 51090: "OriginalBestQualityFinalSize",
    51091: "OriginalDefaultCropSize", 51105: "CameraLabel", 51107: "ProfileHueSatMapEncoding",
    51108: "ProfileLookTableEncoding", 51109: "BaselineExposureOffset", 51110: "DefaultBlackRender",
    51111: "NewRawImageDigest", 51112: "RawToPreviewGain", 51125: "DefaultUserCrop",
    51177: "DepthFormat", 51178: "DepthNear", 51179: "DepthFar", 51180: "DepthUnits",
    51181: "DepthMeasureType", 51182: "EnhanceParams", 52525: "ProfileGainTableMap",
    52526: "SemanticName", 52528: "SemanticInstanceID", 52529: "CalibrationIlluminant3",
    52530: "CameraCalibration3", 52531: "ColorMatrix3", 52532: "ForwardMatrix3",
    52533: "IlluminantData1", 52534: "IlluminantData2", 52535: "IlluminantData3",
    52536: "MaskSubArea", 52537: "ProfileHueSatMapData3", 52538: "ReductionMatrix3",
    52543: "RGBTables", 52544: "ProfileGainTableMap2", 52547: "ColumnInterleaveFactor",
    52548: "ImageSequenceInfo", 52550: "ImageStats", 52551: "ProfileDynamicRange",
    52552: "ProfileGroupName", 52553: "JXLDistance", 52554: "JXLEffort", 52555: "JXLDecodeSpeed",
}  # fmt: skip
DNG = Vocabulary.of(
    "DNG",
    "Digital Negative Specification 1.7.1 (Adobe 2023)",
    {
        "used": {
            "the filter array": "CFAPlaneColor CFALayout",
            "levels": "LinearizationTable BlackLevelRepeatDim BlackLevel BlackLevelDeltaH "
            "BlackLevelDeltaV WhiteLevel MaskedAreas",
            "the visible area": "ActiveArea",
            "colours for two lights": "ColorMatrix1 ColorMatrix2 CameraCalibration1 "
            "CameraCalibration2 AnalogBalance CalibrationIlluminant1 CalibrationIlluminant2",
            "white balance": "AsShotNeutral AsShotWhiteXY",
            "noise, for clpipe calibrate": "NoiseProfile",
            "how samples are stored": "SubTileBlockSize RowInterleaveFactor ColumnInterleaveFactor",
            "the camera": "UniqueCameraModel DNGVersion DNGBackwardVersion",
        },
        "named": {
            "corrections of defects, shading and distortion": "OpcodeList1 OpcodeList2 OpcodeList3",
            "gains for parts of the picture": "ProfileGainTableMap ProfileGainTableMap2",
            "colours of a finished picture, not of a scene": "ColorimetricReference",
            "colours for a third light": "ColorMatrix3",
            "the spectrum of a light": "IlluminantData1 IlluminantData2 IlluminantData3",
            "brightness, in EV": "BaselineExposure BaselineExposureOffset",
            "four colours to three": "ReductionMatrix1 ReductionMatrix2 ReductionMatrix3",
            "pixels that are not square": "DefaultScale",
        },
        "ignored": {
            "clpipe shows the whole visible area": "DefaultCropOrigin DefaultCropSize "
            "DefaultUserCrop OriginalDefaultCropSize OriginalDefaultFinalSize "
            "OriginalBestQualityFinalSize BestQualityScale",
            "another way to the same colours": "ForwardMatrix1 ForwardMatrix2 ForwardMatrix3 "
            "CameraCalibration3 CalibrationIlluminant3 CameraCalibrationSignature",
            "a converter's look, in place of which clpipe has its own": "ProfileName "
            "ProfileHueSatMapDims ProfileHueSatMapData1 ProfileHueSatMapData2 "
            "ProfileHueSatMapData3 ProfileHueSatMapEncoding ProfileLookTableDims "
            "ProfileLookTableData ProfileLookTableEncoding ProfileToneCurve RGBTables "
            "ProfileDynamicRange ProfileGroupName ProfileCalibrationSignature "
            "ProfileEmbedPolicy ProfileCopyright ExtraCameraProfiles AsShotProfileName "
            "AsShotICCProfile AsShotPreProfileMatrix CurrentICCProfile CurrentPreProfileMatrix "
            "DefaultBlackRender ShadowScale",
            "hints for a converter's sharpening and denoising": "BaselineNoise BaselineSharpness "
            "BayerGreenSplit LinearResponseLimit ChromaBlurRadius AntiAliasStrength "
            "NoiseReductionApplied EnhanceParams RawToPreviewGain ImageStats",
            "the lens and the camera's name": "LensInfo LocalizedCameraModel CameraSerialNumber "
            "CameraLabel TStop",
            "of other files and previews": "DNGPrivateData MakerNoteSafety RawDataUniqueID "
            "OriginalRawFileName OriginalRawFileData OriginalRawFileDigest RawImageDigest "
            "NewRawImageDigest PreviewApplicationName PreviewApplicationVersion "
            "PreviewSettingsName PreviewSettingsDigest PreviewColorSpace PreviewDateTime",
            "of sequences": "TimeCodes FrameRate ReelName ImageSequenceInfo",
            "depth and masks next to the picture": "DepthFormat DepthNear DepthFar DepthUnits "
            "DepthMeasureType SemanticName SemanticInstanceID MaskSubArea",
            "how samples were compressed": "JXLDistance JXLEffort JXLDecodeSpeed",
        },
    },
)
# Compressions that LibRaw cannot decode, by the number in the tag Compression.
COMPRESSIONS = {52546: "JPEG XL", 34892: "lossy JPEG", 50000: "Zstandard", 50002: "JPEG XL"}
COMPRESSIONS |= {34925: "LZMA", 50001: "WebP"}
COMPRESSION, DEFAULT_SCALE = 259, 50718  # tags
EXIF_SRGB = 1  # of Exif's ColorSpace
OWN_SENTENCES = ("PixelAspectRatio", "whiteLuminance", "ICCProfile", "iCCP")  # with their values

_OPENEXR_NAMES = {OIIO_NAMES.get(name, name): name for name in OPENEXR.statements}

CLIP = Vocabulary.of(
    "Clips",
    "ITU-T H.273 (2024) and FFmpeg's names of streams and metadata",
    {
        "used": {
            "samples": "codec pixel_format width height",
            "primaries": "color_primaries",
            "matrix from luma and chroma to RGB, or RGB": "colorspace",
            "limited or full range": "color_range",
            "which side is up": "rotation rotate",
            "when frames are shown": "pts time_base average_rate",
        },
        "checked": {
            "the transfer curve, which must be one for SDR": "color_trc",
            "the end of the last frame": "duration",
        },
        "named": {
            "width of a pixel over its height": "sample_aspect_ratio",
            "fields that were taken one after the other": "interlaced",
            "opacity": "alpha",
            "video streams after the first": "nb_streams",
            "two views in a frame": "stereo_mode",
        },
        "ignored": {
            "what wrote the file": "encoder ENCODER vendor_id handler_name major_brand "
            "minor_version compatible_brands _STATISTICS_WRITING_APP",
            "when, where and by whom it was made": "creation_time timecode location date artist "
            "copyright",
            "text": "title comment description language",
            "sizes of streams": "DURATION BPS NUMBER_OF_FRAMES NUMBER_OF_BYTES",
            "other streams": "audio subtitle",
        },
    },
)

LAYERS = Vocabulary.of(
    "Layers of renders",
    "the manuals of Blender 5, Arnold, V-Ray, RenderMan, Karma, LuxCore, Mitsuba and Unreal; "
    "spaces and case do not matter",
    {
        "used": {
            "the picture": " ".join(filter(None, PICTURE_LAYERS)),
            **{f"{kind}, with --carry": " ".join(names) for kind, names in KIND_NAMES.items()},
        },
        "rejected": {
            f"as the picture, unless --layer names it; from {program}": names
            for program, names in AOVS.items()
        },
    },
)


def vocabulary_warnings(path: Path, format_: str, spec: Any, chunks: Iterable[bytes]) -> list[str]:
    """Return sentences about what a file states, and clpipe does not use.

    Args:
        path: the file.
        format_: OpenImageIO's name of its format.
        spec: its ``oiio.ImageSpec``.
        chunks: the names of the chunks of a PNG.
    """
    if format_ == "openexr":
        return list(_openexr_warnings(tuple(each.name for each in spec.extra_attribs)))
    if format_ == "png":
        names = (name.decode("latin-1") for name in chunks)
        return PNG.warnings(name for name in names if name not in OWN_SENTENCES)
    if format_ == "jpeg":
        space = spec.getattribute("Exif:ColorSpace")
        has_profile = spec.getattribute("ICCProfile") is not None
        is_other = space not in (None, EXIF_SRGB) and not has_profile
        return JPEG.warnings(["Exif:ColorSpace"] if is_other else ())
    if format_ == "tiff":
        # A damaged directory has no tags.
        names = (TiffTags.lookup(tag).name for tag in next(read_directories(path), ()))
        return TIFF.warnings(name for name in names if name not in OWN_SENTENCES)
    return []


@lru_cache(maxsize=256)
def _openexr_warnings(names: tuple[str, ...]) -> tuple[str, ...]:
    stated = (_OPENEXR_NAMES.get(name, name) for name in names if name not in OWN_SENTENCES)
    return tuple(OPENEXR.warnings(name for name in stated if not name.startswith(LIBRARY)))


def dng_warnings(path: Path) -> list[str]:
    """Return sentences about what a DNG states, and clpipe does not use; [] for other raws."""
    stated = {
        DNG_TAGS[tag]
        for directory in read_directories(path)
        for tag, values in directory.items()
        if tag in DNG_TAGS and any(values) and not (tag == DEFAULT_SCALE and {*values} == {1})
    }
    return DNG.warnings(sorted(stated)) if "DNGVersion" in stated else []


def raw_compression(path: Path) -> str:
    """Return the compression of a raw that LibRaw cannot decode; "" if there is none.

    >>> raw_compression(Path("missing.dng"))
    ''
    """
    found = [n for each in read_directories(path) for n in each.get(COMPRESSION, ())]
    names = [f"{COMPRESSIONS[n]} (number {n})" for n in found if n in COMPRESSIONS]
    return names[0] if names else ""
