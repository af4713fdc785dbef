"""Stages: the kinds of images they read and write, how they access pixels, their parameters.

Each stage is declared once, in ``clpipe/stages/<name>.py``, as a :class:`Stage` with one or more
:class:`Method` classes. The fields of a method are its parameters. Their validation, help,
``--set``, kernel arguments and sidecar entries are all derived from that declaration.

Stage files import only the names in ``__all__`` here, and only from here. This package imports
``camera``, ``reference`` and ``base``, and nothing about chains, devices or files.
"""

from clpipe.base.pure import pure
from clpipe.base.types import Array, Floats
from clpipe.stage.arrays import PERIOD, levels_table, period_of
from clpipe.stage.bases import (
    Curve,
    FocalLengthMethod,
    GaussianNoise,
    LayerMethod,
    LensMethod,
    Noiseless,
    PrincipalPointMethod,
    Span,
    Unchanged,
    odd_size,
    principal_point_parameter,
)
from clpipe.stage.checking import run_reference, variant_label, variants
from clpipe.stage.context import Context, ImageLayer, ReferenceContext
from clpipe.stage.method import (
    Method,
    Stage,
    StageRole,
    camera_parameter,
    optics_parameter,
    parameter,
    rgb_stage,
    sensor_stage,
)
from clpipe.stage.passes import (
    PREVIOUS,
    Argument,
    Arguments,
    Bands,
    CompileTime,
    Kind,
    LineTable,
    NoiseScope,
    Pass,
    Pointwise,
    Reduction,
    Resample,
    Stencil,
    TableLookup,
    bytes_of,
    typed_arguments,
)
from clpipe.stage.signal import Backend, Numbers, Signal, SignalMethod, sensor_bits, sensor_normals

__all__ = [
    "PERIOD",
    "PREVIOUS",
    "Argument",
    "Arguments",
    "Array",
    "Backend",
    "Bands",
    "CompileTime",
    "Context",
    "Curve",
    "Floats",
    "FocalLengthMethod",
    "GaussianNoise",
    "ImageLayer",
    "Kind",
    "LayerMethod",
    "LensMethod",
    "LineTable",
    "Method",
    "NoiseScope",
    "Noiseless",
    "Numbers",
    "Pass",
    "Pointwise",
    "PrincipalPointMethod",
    "Reduction",
    "ReferenceContext",
    "Resample",
    "Signal",
    "SignalMethod",
    "Span",
    "Stage",
    "StageRole",
    "Stencil",
    "TableLookup",
    "Unchanged",
    "bytes_of",
    "camera_parameter",
    "levels_table",
    "odd_size",
    "optics_parameter",
    "parameter",
    "period_of",
    "principal_point_parameter",
    "pure",
    "rgb_stage",
    "run_reference",
    "sensor_bits",
    "sensor_normals",
    "sensor_stage",
    "typed_arguments",
    "variant_label",
    "variants",
]
