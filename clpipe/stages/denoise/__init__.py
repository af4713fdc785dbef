"""Denoising of luma and, more strongly, of chroma; the strength follows the predicted noise."""

from clpipe.stage import Context, StageRole, rgb_stage
from clpipe.stages.denoise import strength
from clpipe.stages.denoise.bilateral import Bilateral
from clpipe.stages.denoise.biweight import Biweight
from clpipe.stages.denoise.blended import Mean, Median
from clpipe.stages.denoise.non_local_means import NonLocalMeans

METHODS = (Biweight, Bilateral, NonLocalMeans, Median, Mean)


def explain(context: Context) -> str:
    """Return lines that explain how the strength follows from the noise, and its effects."""
    effects = [f"  {m.method}: {m().resolve(context).effect}" for m in METHODS]
    return "\n".join([strength.explain(context), *effects])


STAGE = rgb_stage(
    "denoise",
    "Reduce noise in luma and chroma, like a camera.",
    METHODS,
    role=StageRole.DENOISING,
    explain=explain,
)
