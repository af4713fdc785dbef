"""The raw noise of a camera for PyTorch tensors in a training loop, on CPUs and GPUs.

It uses only PyTorch: no OpenCL, files or processes. It needs the package ``torch``.
"""

from typing import TYPE_CHECKING, Any

from clpipe.base.extras import install_command

if TYPE_CHECKING:
    from clpipe.torch.raw_noise import RawNoise

__all__ = ["RawNoise"]


def __getattr__(name: str) -> Any:
    """Import an exported name on first use.

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
        raise ImportError(
            f"clpipe.torch needs torch, which is in the extra 'train'. Run: "
            f"{install_command('torch')}"
        ) from None
    return getattr(raw_noise, name)
