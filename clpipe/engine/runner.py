"""Runs a chain on images, on a device or in NumPy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError, RequestError
from clpipe.base.types import Array, Floats
from clpipe.chain.camera_info import CameraInfo, camera_info
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import exposures_of
from clpipe.chain.registry import user_code_errors
from clpipe.chain.sites import with_site_sums
from clpipe.engine.buffers import HostImages, allocate_results, crop_patches, is_planar
from clpipe.engine.device import Device
from clpipe.engine.extents import Box, whole_image
from clpipe.engine.ir import Plan
from clpipe.engine.ops import FrameKind, border_periods, chain_ops, undone
from clpipe.engine.options import DEFAULTS, RunOptions
from clpipe.engine.patches import check_sizes
from clpipe.engine.plan import make_plan
from clpipe.engine.state import State
from clpipe.engine.values import binding, size_estimates
from clpipe.engine.work import Work
from clpipe.reference.curve import to_8_bit
from clpipe.stage import NoiseScope, ReferenceContext

# Plans of chains, by what they depend on. Chains that differ only in run-time values share a plan,
# so they are neither planned nor compiled again.
PLANS: BoundedCache[Plan] = BoundedCache(512)
# The plans of chains that share no structure.
UNSHARED: WeakKeyDictionary[Chain, dict[Any, Plan]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Result:
    """The result of a chain for one image.

    >>> import numpy as np
    >>> import clpipe
    >>> camera = clpipe.Pipeline(device="numpy", keep="normalize")
    >>> result = camera(np.full((24, 32, 3), 0.2, np.float32))
    >>> result
    Result(encoded: (24, 32, 3) uint8, normalize: (24, 32) float32)
    >>> result.image is result.encoded
    True

    The shape of patches is (patch, height, width[, channel]).

    Attributes:
        final: the last image, float32; None if not requested.
        encoded: the last image in eight bits, uint8; None if not requested.
        kept: the images after the steps to keep, float32, by step.
        estimates: the numbers that stages estimated from the image, such as gains, by step and
            name.
        origin: the chain, and the width and height of the image in px; None if they are unknown.
        time: the time of the image, s; None if none was stated.
    """

    final: Floats | None
    encoded: Array | None
    kept: dict[str, Floats]
    estimates: dict[str, dict[str, float]]
    origin: tuple[Chain, tuple[int, int]] | None = field(default=None, repr=False, compare=False)
    time: float | None = None

    @cached_property
    def camera(self) -> CameraInfo:
        """The camera of the image, see :class:`CameraInfo`.

        Raises:
            RequestError: the camera's values contradict each other, or the result is from another
                process.
        """
        if self.origin is None:
            raise RequestError("this result does not know its chain, so its camera is unknown")
        chain, size = self.origin
        is_whole = chain.steps[0].name == chain.names[0]  # else a lens may have been before
        known = chain.intrinsics(*size, {}) if is_whole else None
        return replace(camera_info(chain, self.estimates, size, known), time=self.time)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "origin": None}  # chains cannot leave their process

    @property
    def image(self) -> Array:
        """The last image: in eight bits if the chain ends in display values, else in float."""
        image = self.final if self.encoded is None else self.encoded
        assert image is not None
        return image

    def cropped(self, boxes: Sequence[Box]) -> "Result":
        """Return the parts of the images in boxes, all of one size, as patches."""
        final, encoded = (
            None if image is None else crop_patches(image, boxes)
            for image in (self.final, self.encoded)
        )
        kept = {name: crop_patches(image, boxes) for name, image in self.kept.items()}
        return Result(final, encoded, kept, self.estimates)

    def __repr__(self) -> str:
        shapes = {"final": self.final, "encoded": self.encoded, **self.kept}
        parts = [f"{k}: {v.shape} {v.dtype}" for k, v in shapes.items() if v is not None]
        return f"Result({', '.join(parts)})"

    def _repr_png_(self) -> bytes | None:
        """Return the last image as PNG bytes, for notebooks."""
        from clpipe.images.preview import png_bytes

        return None if self.final is None and self.encoded is None else png_bytes(self.image)


class Runner:
    """Runs one chain on images, on a device or in NumPy.

    Args:
        chain: the chain.
        device: the device; None is NumPy.
        keep: the steps whose images are returned.
        encode: whether the last image is returned in eight bits.
        final: whether the last image is returned in float.
        bands: whether launches run in bands on a CPU. The results are the same.
    """

    def __init__(
        self,
        chain: Chain,
        device: Device | None,
        keep: Sequence[str] = (),
        encode: bool = True,
        final: bool = False,
        bands: bool = True,
    ) -> None:
        self.chain = with_site_sums(chain, tuple(keep))
        self.device = device
        self.keep = tuple(keep)
        self.encode = encode
        self.final = final
        self.bands = bands
        self._exposures = exposures_of(chain)

    @cached_property
    def _exposure_runners(self) -> list["Runner"]:
        """The runners of all exposures but the first, up to the step that merges them."""
        chains = self._exposures.later if self._exposures else ()
        return [Runner(chain, self.device, encode=False, final=True) for chain in chains]

    def plan(
        self,
        half: bool = True,
        fold: bool = True,
        planar: bool = False,
        bands: bool = True,
        frame: FrameKind = FrameKind.SINGLE,
    ) -> Plan:
        """Return the plan for a float16 or float32 source, interleaved or in planes.

        On a CPU, launches run in bands unless ``bands`` is false.
        """
        bands &= self.bands
        planar |= half and self.chain.bands > 0  # half bands have only one layout
        cpu = self.device.info.cpu if self.device and bands else None
        chain, results = self.chain, (self.keep, self.encode, self.final)
        key = *results, half, fold, planar, cpu, frame, undone(chain, frame)

        def plan() -> Plan:
            ops = chain_ops(chain, chain.arguments, FrameKind.LATER)
            periods = tuple(border_periods(chain).values())
            structure = (*key, chain.source, chain.result, ops, periods)
            options = chain, half, *results, fold, planar, cpu, frame
            return PLANS.get(structure, lambda: make_plan(*options))

        known = UNSHARED.setdefault(chain, {}) if chain.structure is None else chain.structure
        if key not in known:
            known[key] = plan()
        found: Plan = known[key]
        return found

    def plan_for(self, image: Array, frame: FrameKind = FrameKind.SINGLE) -> Plan:
        """Return the plan for an image."""
        size = image.shape[1::-1]
        options = image.dtype == np.float16, min(self.chain.size(*size)) > 1, is_planar(image)
        plan = self.plan(*options, frame=frame)
        return self.plan(*options, bands=False, frame=frame) if plan.is_tiny(*size) else plan

    def _plan_for_frame(self, image: Array, state: State) -> Plan:
        """Return the plan for the next frame of a sequence."""
        assert self.device
        plan = self.plan_for(image, FrameKind.LATER)
        width, height = image.shape[1::-1]
        extents = whole_image(plan, width, height, self.device.info.lanes)
        is_first = state.is_first(plan, extents)
        return self.plan_for(image, FrameKind.FIRST) if is_first else plan

    def compile(self, half: bool = True) -> None:
        """Compile all kernels, so that the first image does not wait for the compiler.

        Raises:
            ImageError: even a tiny image does not fit into the device's memory.
            DeviceError: a kernel does not compile, or the device fails.
        """
        if self.device:
            try:
                for runner in (*self._exposure_runners, self):
                    runner._compile_plan(runner.plan(half))
            except DeviceFailedError as error:
                raise DeviceError(str(error)) from None

    def _compile_plan(self, plan: Plan) -> None:
        """Compile the kernels of a plan by running it on a tiny image.

        A launch is necessary because PoCL compiles a kernel again at its first launch.
        """
        assert self.device
        if not self.device.is_compiled(plan):
            width, height = self.chain.margins.image_size(8, 8)
            channels = self.chain.source_channels
            shape = (height, width, channels)[: 2 if channels == 1 else 3]
            tiny = np.zeros(shape, np.float16 if plan.half else np.float32)
            try:
                plan.check_resamplings(width, height)
            except ImageError:
                return  # larger images may still be possible
            self.device.submit([self._work(plan, tiny, "", DEFAULTS)])[0]()

    def run(self, image: Array, noise_key: str, options: RunOptions = DEFAULTS) -> Result:
        """Run the chain on one image, and return the result.

        Other code than tests and benchmarks uses :class:`clpipe.engine.service.Service`.

        Args:
            image: (height, width, 3) linear RGB, or (height, width) for a chain that starts on a
                mosaic. It must be finite, of float16 or any type that converts to float32.
            noise_key: the text from which the noise is seeded; see
                :func:`clpipe.chain.identity.noise_key`.
            options: the options of the run.

        Raises:
            ImageError: the image has the wrong shape, or does not fit into the device's memory.
            DeviceFailedError: the device failed for this image.
            DeviceError: a kernel does not compile, or the device failed for too many images.
        """
        work = self.work(image, noise_key, options)
        if isinstance(work, Work):
            assert self.device
            return self.device.submit([work])[0]()
        return work()

    def work(
        self, image: Array, noise_key: str, options: RunOptions = DEFAULTS
    ) -> Work[Result] | Callable[[], Result]:
        """Return the work of one image for :meth:`clpipe.engine.device.Device.submit`.

        This call already runs all exposures but the first. Arguments and errors are those of
        :meth:`run`.

        Returns:
            The work; if no device is needed, a callable that returns the result.
        """
        self.check(image)
        runner = self._with_exposures(image, noise_key, options.later_exposures)
        if not (self.encode or self.final or self.keep):
            return lambda: Result(None, None, {}, {})
        if not self.device:
            if options.boxes:
                check_sizes(runner.plan_for(image), *image.shape[1::-1])
            pixels = np.asarray(image, np.float32)
            return partial(runner._run_numpy, pixels, noise_key, options)
        state = options.state
        plan = runner._plan_for_frame(image, state) if state else runner.plan_for(image)
        plan.check_resamplings(*image.shape[1::-1])
        if options.boxes:
            check_sizes(plan, *image.shape[1::-1])
        if not state:
            return runner._work(plan, image, noise_key, options)
        # A frame is processed whole. Without steps with state, it is like any other image.
        whole = replace(options, boxes=(), state=state if plan.states else None)
        work = runner._work(plan, image, noise_key, whole)
        if not options.boxes:
            return work
        finish = work.finish
        return replace(work, finish=lambda output: finish(output).cropped(options.boxes))

    def _work(self, plan: Plan, image: Array, noise_key: str, options: RunOptions) -> Work[Result]:
        """Return the work of one image whose other exposures are done. See :meth:`work`."""
        width, height = image.shape[1::-1]
        return Work(
            plan,
            image,
            binding(self.chain, plan, (width, height), noise_key),
            allocate_results(plan, width, height, options.into, options.boxes),
            options,
            partial(self._result, plan, size_estimates(self.chain, width, height)),
        )

    def _with_exposures(
        self, image: Array, noise_key: str, later_images: Sequence[Array]
    ) -> "Runner":
        """Run all exposures but the first, and return a runner that merges them with the first.

        Args:
            image: the image of the first exposure.
            noise_key: the text from which the noise is seeded.
            later_images: the images of the other exposures; () uses ``image``.

        Returns:
            The runner; this one if the chain has only one exposure.

        Raises:
            ImageError, DeviceFailedError, DeviceError: as for :meth:`run`.
        """
        if not self._exposures or not (self.encode or self.final or self.keep):
            return self
        pairs = zip(
            self._exposure_runners,
            later_images or [image] * len(self._exposure_runners),
            strict=True,
        )
        exposure_images = [runner.run(exposure, noise_key).image for runner, exposure in pairs]
        merged = self._exposures.merge_chain(exposure_images)
        return Runner(merged, self.device, self.keep, self.encode, self.final, self.bands)

    def check(self, image: Array) -> None:
        """Check that an image has the shape that the chain starts on.

        Raises:
            ImageError: the image has another shape.
        """
        channels = self.chain.source_channels
        shape = image.shape[2] if image.ndim == 3 else 1
        if image.ndim not in (2, 3) or shape != channels or 0 in image.shape:
            axes = "(height, width)" if channels == 1 else f"(height, width, {channels})"
            raise ImageError(
                f"the image has shape {image.shape}, but the chain starts on "
                f"{self.chain.source.label}, {axes}"
            )

    @staticmethod
    def _result(plan: Plan, from_size: dict[str, dict[str, float]], output: HostImages) -> Result:
        """Return the results of an image, from the device's output."""
        names = plan.estimates
        return Result(
            final=output.images.get(plan.final.number) if plan.final else None,
            encoded=output.encoded,
            kept={name: output.images[i.number] for name, i in plan.kept if output.images},
            estimates=from_size
            | {
                step: dict(zip(names[step], map(float, values), strict=False))
                for step, values in output.estimates.items()
            },
        )

    def _run_numpy(self, image: Floats, noise_key: str, options: RunOptions) -> Result:
        kept: dict[str, Floats] = {}
        estimates: dict[str, dict[str, float]] = {}
        state = options.state
        whole = self.encode or self.final
        steps = (self.chain if whole else self.chain.up_to(self.keep)).steps
        for step in steps:
            from_size = dict(step.method.estimates_for(*image.shape[1::-1]))
            streams = {s: self.chain.stream(step.name, s, noise_key) for s in NoiseScope}
            previous = state.array(step, image.shape) if state else None
            context = ReferenceContext(step.context, streams, from_size, previous)
            with user_code_errors(f"stage {step.name}", step.stage.folder):
                image = step.method.reference(image, context)
            if state:
                state.keep_array(step, image)
            if step.name in self.keep:
                kept[step.name] = image
            if context.estimates:
                estimates[step.name] = context.estimates
        result = Result(
            final=image if self.final or steps[-1].name in self.keep else None,
            encoded=to_8_bit(image) if self.encode else None,
            kept=kept,
            estimates=estimates,
        )
        return result.cropped(options.boxes) if options.boxes else result
