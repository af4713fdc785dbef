"""Stacks of views, which share launches, and arrays of other libraries."""

import numpy as np
import pytest

import clpipe
from clpipe.base.errors import ImageError, RequestError

VIEWS = np.random.default_rng(0).random((20, 24, 32, 3)).astype(np.float32) / 2
NAMES = [f"env{number}/front" for number in range(len(VIEWS))]
OWN = [
    {"camera": ("sony-a7r2", "nikon-d850")[number % 2], "iso": (100, 800, 3200)[number % 3]}
    for number in range(len(VIEWS))
]


def same(one, two):
    assert np.array_equal(one.image, two.image)
    assert one.kept.keys() == two.kept.keys()
    assert all(np.array_equal(image, two.kept[name]) for name, image in one.kept.items())


@pytest.mark.parametrize("device", [None, "numpy"])
@pytest.mark.parametrize("own", [None, OWN])
def test_views_are_the_same_together_and_one_by_one(device, own):
    camera = clpipe.Pipeline(device=device, keep="quantize")
    together = list(camera.process_many(VIEWS, NAMES, own, exposure={"ev": 0.5}))
    for number, shot in enumerate(together):
        settings = own[number] if own else {}
        one = camera.process(VIEWS[number], NAMES[number], exposure={"ev": 0.5}, **settings)
        same(shot, one)
        assert shot.camera == one.camera
        assert shot.camera.iso == settings.get("iso", 100)


def test_a_views_own_setting_replaces_that_of_all():
    camera = clpipe.Pipeline(device="numpy")
    shots = camera.process_many(VIEWS[:2], ["a", "b"], [{"iso": 400}, {}], iso=200)
    assert [shot.camera.iso for shot in shots] == [400, 200]


def test_names_and_times():
    camera = clpipe.Pipeline(device="numpy", iso=3200)
    first = list(camera.process_many(VIEWS[:2]))
    again = list(clpipe.Pipeline(device="numpy", iso=3200).process_many(VIEWS[:2], ["0", "1"]))
    later = list(camera.process_many(VIEWS[:2], times=[0.25, 0.5]))
    for one, two, three in zip(first, again, later, strict=True):
        same(one, two)
        assert not np.array_equal(one.image, three.image)  # its key is 2 or 3
    assert [shot.camera.time for shot in later] == [0.25, 0.5]
    assert first[0].camera.time is None


def test_launches_are_shared(launches):
    camera = clpipe.Pipeline(keep="quantize")
    list(camera.process_many(VIEWS, NAMES))
    launches.clear()
    list(camera.process_many(VIEWS, NAMES))
    together = len(launches)
    launches.clear()
    for view, name in zip(VIEWS, NAMES, strict=True):
        camera.process(view, name)
    assert together * 8 < len(launches)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((VIEWS[:3], ["a"]), "found 1 names, but the stack has 3 views"),
        ((VIEWS[:3], None, [{}]), "found 1 views, but the stack has 3 views"),
        (([VIEWS[0]], ["a"]), "belong to the views of a stack"),
        ((VIEWS[0],), "expected"),
        ((np.float32(3),), "a stack of images is expected"),
        ((VIEWS[:2, ..., :2],), "is expected"),
    ],
)
def test_rejected_stacks(arguments, message):
    with pytest.raises((RequestError, ImageError), match=message):
        list(clpipe.Pipeline(device="numpy").process_many(*arguments))


def test_names_and_times_may_be_arrays():
    camera = clpipe.Pipeline(device="numpy", iso=800)
    names, times = np.array(["a", "b"]), np.array([0.0, 0.5])
    found = list(camera.process_many(VIEWS[:2], names, times=times))
    assert [each.camera.time for each in found] == [0.0, 0.5]
    assert np.array_equal(found[1].image, camera.process(VIEWS[1], "b").image)


class Interface:
    """An array of another library that shares its memory by NumPy's interface, like Warp's."""

    def __init__(self, array):
        self.__array_interface__ = array.__array_interface__
        self._owner = array


class OnGpu:
    """An array in a GPU's memory whose library copies it to the host, as DLPack 1 allows."""

    def __init__(self, array, copies=True):
        self._array, self._copies = array, copies

    def __dlpack_device__(self):
        return (2, 0)

    def __dlpack__(self, *, dl_device=None, **options):
        if not self._copies or dl_device != (1, 0):
            raise BufferError("the memory is on a GPU")
        return self._array.copy().__dlpack__()


def test_arrays_of_other_libraries():
    camera = clpipe.Pipeline(device="numpy")
    expected = list(camera.process_many(VIEWS[:2], NAMES[:2]))
    copies = [OnGpu(VIEWS[:2])] if np.lib.NumpyVersion(np.__version__) >= "2.1.0" else []
    for stack in (Interface(VIEWS[:2]), *copies):
        for one, two in zip(camera.process_many(stack, NAMES[:2]), expected, strict=True):
            same(one, two)
    with pytest.raises(ImageError, match=r"If it is on a GPU, pass images\.cpu\(\)"):
        list(camera.process_many(OnGpu(VIEWS[:2], copies=False)))
