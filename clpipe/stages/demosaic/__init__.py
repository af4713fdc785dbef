"""Demosaicing: interpolates three colours at every pixel; each algorithm has its own file."""

from clpipe.stage import Context, Kind, Method, Stage
from clpipe.stages.demosaic.bilinear import Bilinear
from clpipe.stages.demosaic.bounded import Bounded
from clpipe.stages.demosaic.directional_mmse import DirectionalMmse
from clpipe.stages.demosaic.edge_directed import EdgeDirected
from clpipe.stages.demosaic.linear_mmse import Gray, LinearMmse
from clpipe.stages.demosaic.malvar2004 import Malvar2004
from clpipe.stages.demosaic.median import EdgeDirectedMedian, Median
from clpipe.stages.demosaic.menon2007 import Menon2007


def _array_default(context: Context) -> Method | None:
    if not context.array:
        return None
    return Gray() if context.array.is_gray else LinearMmse()


STAGE = Stage(
    "demosaic",
    "Interpolate the two missing colours of every pixel.",
    Kind.MOSAIC,
    Kind.RGB,
    (
        *(Bounded, EdgeDirectedMedian, EdgeDirected, Median, Bilinear, Malvar2004, Menon2007),
        *(LinearMmse, DirectionalMmse, Gray),
    ),
    default_method=_array_default,
)
