"""Denoising in luma and chroma, chroma stronger, as strong as the ISO asks for."""

from clpipe.stage import Kind, Stage
from clpipe.stages.denoise.bilateral import Bilateral
from clpipe.stages.denoise.law import explain
from clpipe.stages.denoise.mean import Mean
from clpipe.stages.denoise.median import Median
from clpipe.stages.denoise.non_local_means import NonLocalMeans

STAGE = Stage(
    "denoise",
    "Take noise away, as a camera does.",
    Kind.RGB,
    Kind.RGB,
    (Bilateral, NonLocalMeans, Median, Mean),
    explain,
)
