"""The service: frames of any thread and kind give the results that each gives alone."""

import gc
import itertools
import multiprocessing
import threading
import time
import weakref

import numpy as np
import pytest

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.device import Device
from clpipe.engine.ops import chain_ops
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.engine.service import Frame, Service, picture
from clpipe.stage import Kind
from clpipe.stages import DEFAULT_CHAIN

SIZES = [(24, 32), (1, 40), (40, 1), (37, 53), (24, 32), (700, 900)]
GUARD = 60  # s


def frames(settings=(), sizes=SIZES):
    """Return frames of several sizes, each with an ISO of its own."""
    return [
        picture(
            make_chain(settings_from({**dict(settings), "iso": 200 * (number + 1)})),
            example(Kind.RGB, size, half=True, seed=number),
            f"key {number}",
            ("normalize",),
        )
        for number, size in enumerate(sizes)
    ]


def alone(frame, device):
    return frame.runner(device).run(frame.pixels, frame.noise_key, frame.options)


def same(one, two):
    assert np.array_equal(one.image, two.image)
    assert one.kept.keys() == two.kept.keys()
    assert all(np.array_equal(one.kept[name], two.kept[name]) for name in one.kept)


def test_frames_of_several_threads_have_the_results_that_each_has_alone(device):
    service, ordered, found = Service([device]), frames(), {}
    expected = [alone(frame, device) for frame in ordered]

    def ask(first):
        developments = service.develop(ordered[first::2])
        found[first] = [each.result(GUARD) for each in developments]

    threads = [threading.Thread(target=ask, args=(first,)) for first in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for first, results in found.items():
        for result, other in zip(results, expected[first::2], strict=True):
            same(result, other)


@pytest.mark.parametrize("numpy", [False, True])
def test_a_frame_that_fails_does_not_disturb_those_with_it(device, numpy):
    on = None if numpy else device
    ordered = frames(sizes=SIZES[:4])
    ordered[1] = picture(ordered[1].chain, np.zeros((8, 8, 5), np.float32), "five channels")
    wrong, *right = [Service([on]).develop(ordered)[n] for n in (1, 0, 2, 3)]
    with pytest.raises(ImageError, match=r"shape \(8, 8, 5\)"):
        wrong.result(GUARD)
    for development, number in zip(right, (0, 2, 3), strict=True):
        same(development.result(GUARD), alone(ordered[number], on))


def test_an_image_that_does_not_fit_fails_alone(device):
    large = example(Kind.RGB, (600, 800), half=True, seed=0)
    small = frames(sizes=[(8, 8), (8, 9)])
    gray = make_chain(settings_from({"white_balance": {"method": "gray_world"}}))
    on = Device(device.info, memory=600_000)
    tall = Frame(gray, large, "", options=RunOptions(boxes=[*[_box(500)]]))
    first, second, third = Service([on]).develop([small[0], tall, small[1]])
    with pytest.raises(ImageError, match="memory"):
        second.result(GUARD)
    same(first.result(GUARD), alone(small[0], device))
    same(third.result(GUARD), alone(small[1], device))


def _box(size):
    from clpipe.engine.extents import Box

    return Box(0, 0, size, size)


class Broken(Device):
    """A device that fails for every image."""

    def submit(self, works):
        raise DeviceError("it is given up")


def test_another_device_takes_over(device, caplog):
    is_broken = threading.Event()

    class First(Broken):
        def submit(self, works):
            is_broken.set()
            return super().submit(works)

    devices = First(device.info), Device(device.info)

    def prepare(each):  # the second device takes no frame before the first one is broken
        assert each is devices[0] or is_broken.wait(GUARD)

    service, ordered = Service(devices, prepare), frames()
    for frame in ordered * 2:
        (development,) = service.develop([frame])
        same(development.result(GUARD), alone(frame, device))
    assert caplog.text.count("it is given up; the other devices continue") == 1


def test_the_last_device_fails_its_frames_and_tries_the_next(device):
    on = Broken(device.info)
    service, (frame, *_) = Service([on]), frames()
    for develop in (service.run, lambda each: service.develop([each])[0].result(GUARD)) * 2:
        with pytest.raises(DeviceError, match="it is given up"):
            develop(frame)
    on.submit = device.submit
    same(service.run(frame), alone(frame, device))


def test_nothing_is_developed_on_a_device_that_cannot_be_prepared():
    def prepare(device):
        raise DeviceFailedError("no kernels")

    service, (frame, *_) = Service([None], prepare), frames()
    for _ in range(2):
        with pytest.raises(DeviceFailedError, match="no kernels"):
            service.develop([frame])[0].result(GUARD)
    service.close()


def test_no_frame_follows_the_end(device):
    service, ordered = Service([device]), frames()
    assert service.develop([]) == []
    developments = service.develop(ordered)
    service.close()
    assert all(each.done() for each in developments)
    with pytest.raises(ImageError, match="the run ended before this image was developed"):
        service.run(ordered[0])
    service.close()


def test_its_thread_ends_with_it():
    service = Service([None])
    service.develop(frames()[:1])[0].result(GUARD)
    (thread,) = [each for each in threading.enumerate() if each in service._threads]
    gone = weakref.ref(service)
    del service
    gc.collect()
    thread.join(GUARD)
    assert gone() is None and not thread.is_alive()


def results_in(service, frame, queue):
    (development,) = service.develop([frame])
    queue.put(development.result(GUARD).image)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_numpy_serves_a_fork(device):
    service, (frame, *_) = Service([None]), frames()
    expected = service.develop([frame])[0].result(GUARD).image
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    process = context.Process(target=results_in, args=(service, frame, queue))
    process.start()
    assert np.array_equal(queue.get(), expected)
    process.join(GUARD)
    assert process.exitcode == 0


def test_plans_are_shared_by_structure(device):
    iso = [make_chain(settings_from({"iso": number})) for number in (100, 3200)]
    one, two = (Runner(chain, device).plan() for chain in iso)
    assert one is two
    assert Runner(iso[0], device, ("normalize",)).plan() is not one
    assert Runner(iso[0], None).plan() is not one  # no bands
    # Borders of a mosaic are filled by its period, which no pass contains.
    settings = {"stages": ["mosaic", "remosaic"], "remosaic": {"method": "linear_mmse"}}
    arrays = [
        make_chain(
            settings_from({**settings, "mosaic": {"method": "array", "array": array}}),
            start_at="remosaic",
        )
        for array in ("RGB/GBR/BRG", "x-trans")
    ]
    passes = [chain_ops(chain, chain.arguments) for chain in arrays]
    assert passes[0] == passes[1]
    wide, narrow = (Runner(chain, None, encode=False, final=True).plan() for chain in arrays)
    assert wide is not narrow


@pytest.mark.parametrize("has_state", [False, True])
def test_whether_a_pass_undoes_another_is_known_for_each_chain(has_state):
    """Denoising takes the roots that demosaicing has left, if both have one offset."""
    stages = [*DEFAULT_CHAIN]
    if has_state:
        stages.insert(stages.index("denoise"), "temporal_denoise")
    settings = settings_from(
        {
            "stages": stages,
            "demosaic": {"method": "bounded", "offset": 0.004},
            "denoise": {"offset": {"choice": [0.004, 0.02]}},
        }
    )
    plans = {}
    for key in "abcdefghijkl":
        chain = make_chain(settings.drawn(key))
        plan, offset = Runner(chain, None).plan(), chain.step_named("denoise").method.offset
        assert plans.setdefault(offset, plan) is plan
    assert len(plans) == 2 and plans[0.004] is not plans[0.02]


def test_a_device_that_fails_after_the_end_leaves_no_frame_waiting(device):
    class Late(Broken):
        def submit(self, works):
            is_closing.wait(GUARD)
            return super().submit(works)

    is_closing = threading.Event()
    service, (frame, *_) = Service([Late(device.info), Late(device.info)]), frames()
    developments = [each for _ in range(2) for each in service.develop([frame])]
    closer = threading.Thread(target=service.close)
    closer.start()
    is_closing.set()
    closer.join(GUARD)
    assert not closer.is_alive()
    for development in developments:
        with pytest.raises((ImageError, DeviceError)):
            development.result(GUARD)


def test_a_thread_that_cannot_start_ends_the_others(device, monkeypatch):
    start, numbers = threading.Thread.start, itertools.count()

    def starting(thread):
        if next(numbers) == 1:
            raise RuntimeError("can't start new thread")
        start(thread)

    service, (frame, *_) = Service([None, None]), frames()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", starting)
        with pytest.raises(RuntimeError, match="can't start"):
            service.develop([frame])
    service.develop([frame])[0].result(GUARD)


def test_numpy_develops_one_frame_at_a_time():
    """A frame takes much memory in NumPy."""
    lock, most, inside = threading.Lock(), [], []

    class Watched(Frame):
        def runner(self, device):
            return self

        def run(self, *_):
            with lock:
                inside.append(self)
                most.append(len(inside))
            time.sleep(0.01)
            with lock:
                inside.remove(self)

    (frame, *_), service = frames(), Service([None])
    watched = Watched(frame.chain, frame.pixels, "k")
    threads = [threading.Thread(target=service.run, args=(watched,)) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(GUARD)
    assert most == [1] * 6
