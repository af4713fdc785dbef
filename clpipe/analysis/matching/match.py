"""The process of ``clpipe match``, from pictures to a development."""

from collections.abc import Sequence
from pathlib import Path

from clpipe.analysis.matching.charts import as_toned, read_charts
from clpipe.analysis.matching.result import Match, measured
from clpipe.analysis.matching.scenes import load_scenes
from clpipe.analysis.matching.search import Search, Watch
from clpipe.analysis.matching.space import space_for
from clpipe.base.files import check_suffix
from clpipe.chain.isos import check_cameras
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import open_device


def check_names(output: Path, plot: Path | None) -> None:
    """Check the extensions of the files to write.

    Raises:
        RequestError: one is wrong.
    """
    check_suffix("-o", output, ".toml")
    if plot is not None:
        check_suffix("--plot", plot, ".png")


def match_files(
    frames: Sequence[str],
    means: Sequence[str],
    camera: str | None = None,
    iso: float | None = None,
    device: str | None = None,
    charts: Sequence[Path] = (),
    watch: Watch | None = None,
) -> Match:
    """Find the development whose noise matches the noise of pictures.

    Args:
        frames: files or globs, see :func:`clpipe.analysis.matching.scenes.load_scenes`.
        means: files or globs of their means; none for a burst.
        camera: the camera whose raw noise is developed; None is the default camera.
        iso: the ISO; None finds it.
        device: a device that ``clpipe devices`` lists, or "numpy"; None chooses.
        charts: pictures of charts by the same camera, which set sharpness and tone.
        watch: receives the progress, and may stop the search.

    Raises:
        StoppedError: the watch stopped the search.
        RequestError: the pictures do not belong together, or there is no such camera or ISO.
        ImageError: a file cannot be read, or noise cannot be measured in it.
        DeviceError: there is no such device.
    """
    values = {"camera": camera, "iso": iso}
    settings = overlay(Settings(), {k: v for k, v in values.items() if v is not None})
    check_cameras(settings)
    scenes = load_scenes(frames, means)
    opened, seen, tone = open_device(device), read_charts(charts), None
    if seen.greys is not None:
        settings, tone = as_toned(settings, seen.greys, opened)
    space = space_for(settings, iso is not None)
    search = Search(scenes, settings, space, opened, watch)
    return measured(search, search.run(), seen.edge, tone)
