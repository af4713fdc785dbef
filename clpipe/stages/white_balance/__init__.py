"""White balance on the mosaic. Results above 1 are clipped, so clipped highlights are white."""

from clpipe.stage import Kind, Stage, StageRole
from clpipe.stages.white_balance.gains import AsShot, Gains, Unbalanced
from clpipe.stages.white_balance.gray_world import GrayWorld
from clpipe.stages.white_balance.white_patch import WhitePatch

STAGE = Stage(
    "white_balance",
    "Apply white balance gains to red and blue.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (AsShot, GrayWorld, WhitePatch, Gains, Unbalanced),
    role=StageRole.BALANCE,
)
