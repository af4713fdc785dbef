"""Arrays for the Python API: plain ones are accepted, others rejected with a hint."""

import numpy as np
import pytest

from clpipe import ImageError, Pipeline, RawNoise

CHAIN = {"device": "numpy", "stages": ["exposure", "gamma"]}
IMAGE = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)


class Tensor:
    """An array of another library, on the CPU or not."""

    def __init__(self, array: np.ndarray, on_cpu: bool = True, requires_grad: bool = False) -> None:
        self._array, self._on_cpu, self.requires_grad = array, on_cpu, requires_grad

    def __dlpack__(self, **_: object) -> object:
        if not self._on_cpu:
            raise BufferError("unsupported device")
        return self._array.__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        return (1, 0) if self._on_cpu else (2, 0)


def test_tensors_on_the_cpu_are_taken_as_they_are():
    pipeline = Pipeline(**CHAIN)
    made = pipeline.process(Tensor(IMAGE), "a").image
    assert np.array_equal(made, pipeline.process(IMAGE, "a").image)
    moved, _ = pipeline.carry(Tensor(IMAGE[..., 0]), "depth")
    assert np.array_equal(moved, IMAGE[..., 0])
    raw = np.full((4, 8), 0.25, np.float32)
    add_noise = RawNoise("sony-a7r2", 800, device="numpy")
    assert np.array_equal(add_noise(Tensor(raw), "k"), add_noise(raw, "k"))


def test_torch_tensors_are_taken():
    torch = pytest.importorskip("torch", reason="needs PyTorch, in the extra train")
    pipeline = Pipeline(**CHAIN)
    made = pipeline.process(torch.from_numpy(IMAGE), "a").image
    assert np.array_equal(made, pipeline.process(IMAGE, "a").image)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ((IMAGE * 255).astype(np.uint8), "type uint8, .* pass image / np.float32.WHITE."),
        (IMAGE > 0.5, "type bool, but the chain expects rgb as floats"),
        (IMAGE.tolist(), "a list, but an array is expected. Pass numpy.asarray"),
        (
            np.dstack([IMAGE, IMAGE[..., :1]]),
            r"\(6, 8, 4\), .*To leave out alpha, pass image\[..., :3\]",
        ),
        (IMAGE[..., 0], r"\(6, 8\), .*For a grey image, pass np.repeat"),
        (IMAGE[..., :1], r"\(6, 8, 1\), .*For a grey image, pass np.repeat"),
        (np.moveaxis(IMAGE, -1, 0), r"\(3, 6, 8\), .*pass np.moveaxis"),
        (IMAGE[None], r"\(1, 6, 8, 3\), .*For a batch, use process_many"),
        (IMAGE[:0], r"has shape \(0, 8, 3\), but \(height, width, 3\) is expected"),
        (
            Tensor(IMAGE, on_cpu=False),
            r"a Tensor whose memory cannot be shared .* pass image.cpu\(\)",
        ),
        (Tensor(IMAGE, requires_grad=True), r"a Tensor with a gradient. Pass image.detach\(\)"),
    ],
)
def test_what_is_refused_says_what_helps(image, message):
    with pytest.raises(ImageError, match=f"^view_7: (the )?image .*{message}"):
        Pipeline(**CHAIN).process(image, "view_7")


@pytest.mark.parametrize(
    ("shape", "way"),
    [
        ((1, 6, 8), r"image\[0\]"),
        ((6, 8, 1), r"image\[\.\.\., 0\]"),
        ((6, 8, 3), "start the chain at mosaic or before it"),
        ((6, 8, 5), "For a batch, use .*"),
    ],
)
def test_mosaics_have_two_dimensions(shape, way):
    mosaics = Pipeline(device="numpy", start_at="normalize")
    with pytest.raises(ImageError, match=rf"\(height, width\) is expected\. .*{way}"):
        mosaics.process(np.ones(shape, np.float32), "a")
    with pytest.raises(ImageError, match=r"type int64, .* pass image.astype\(np.uint16\)"):
        mosaics.process(np.ones((6, 8), np.int64), "a")


def test_what_is_not_finite_is_counted_and_placed():
    image = IMAGE.copy()
    image[2, 3, 1] = np.nan
    image[4:, 0] = np.inf
    message = "view_7: the image has 7 samples .*, the first at row 2, column 3, channel 1. .*nan"
    with pytest.raises(ImageError, match=message):
        Pipeline(**CHAIN).process(image, "view_7")


def test_depth_that_nothing_reads_is_a_warning():
    with pytest.warns(UserWarning, match="a: no step reads the depth. Set defocus.method"):
        Pipeline(**CHAIN).process(IMAGE, "a", depth=np.ones((6, 8)))


def test_one_stage_to_skip_is_a_text():
    both = [Pipeline(device="numpy", skip=skip).chain.names for skip in ("gamma", ["gamma"])]
    assert both[0] == both[1] and "gamma" not in both[0]
