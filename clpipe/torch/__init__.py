"""Raw noise on PyTorch tensors, inside a training loop, on a CPU or a GPU.

The package uses only PyTorch: no OpenCL, no files and no processes. It needs the package ``torch``.
"""

from typing import TYPE_CHECKING, Any

from clpipe.base.extras import installing

if TYPE_CHECKING:
    from clpipe.torch.raw_noise import RawNoise

__all__ = ["RawNoise"]


def __getattr__(name: str) -> Any:
    """What is exported, imported on first use.

    Raises:
        ImportError: PyTorch is not installed.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from clpipe.torch import raw_noise
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ImportError(f"clpipe.torch needs torch; {installing('torch')}") from None
    return getattr(raw_noise, name)
