"""A camera's raw noise on PyTorch's tensors, inside a training loop, on a CPU or a GPU.

It is PyTorch alone: no OpenCL, no files, no processes of its own. It needs the extra ``train``.
"""

try:
    from clpipe.torch.raw_noise import RawNoise
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    needed = "clpipe.torch needs torch; pip install 'clpipe[train]'"
    raise ModuleNotFoundError(needed, name="torch") from None

__all__ = ["RawNoise"]
