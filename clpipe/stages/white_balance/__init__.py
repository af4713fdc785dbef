"""White balance on the mosaic. Results above 1 are clipped, so clipped highlights are white."""

from clpipe.stage import Kind, Stage, StageRole
from clpipe.stages.white_balance.gains import AsShot, Gains, Unbalanced
from clpipe.stages.white_balance.gray_world import GrayWorld
from clpipe.stages.white_balance.white_patch import WhitePatch

STAGE = Stage(
    "white_balance",
    "Multiply red and blue so that white surfaces look white.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (AsShot, GrayWorld, WhitePatch, Gains, Unbalanced),
    role=StageRole.BALANCE,
)
