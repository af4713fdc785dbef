"""Denoising in luma and chroma, chroma stronger, as strong as the ISO asks for."""

from clpipe.stage import Context, Kind, Stage
from clpipe.stages.denoise import strength as law
from clpipe.stages.denoise.bilateral import Bilateral
from clpipe.stages.denoise.mean import Mean
from clpipe.stages.denoise.median import Median
from clpipe.stages.denoise.non_local_means import NonLocalMeans

METHODS = (Bilateral, NonLocalMeans, Median, Mean)


def explain(context: Context) -> str:
    """The law, and what it makes of each method at its default strengths, in lines."""
    effects = [f"  {m.method}: {m().resolve(context).effect}" for m in METHODS]
    return "\n".join([law.explain(context), *effects])


STAGE = Stage(
    "denoise",
    "Take noise away, as a camera does.",
    Kind.RGB,
    Kind.RGB,
    METHODS,
    explain,
)
