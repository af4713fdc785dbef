"""Finds the camera of each render of a run, in a file that lists all cameras."""

import contextlib
import os
import re
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.keys import RENDER
from clpipe.chain.methods import make_model
from clpipe.chain.options import Moments
from clpipe.chain.render_camera import RenderCamera
from clpipe.images.claims import display_size
from clpipe.inputs.jobs import Job
from clpipe.inputs.render_cameras import View, read_views

EXTENSION = re.compile(r"\.[A-Za-z]\w{1,4}$")  # the extension of an image; frame.0001 has none


def assign_views(
    jobs: Sequence[Job], path: Path | None, settings: RenderCamera, truth_at: Moments = "middle"
) -> list[Job]:
    """Return the jobs of a run, each with its camera from a file.

    A view belongs to a render if their paths are equal without extensions. The render's path is
    relative to its input folder. If no such view exists, the end of the view's path may equal the
    render's path. Otherwise their file names must be equal, and no other view or render may have
    that name. A job without a valid view gets a ``problem``.

    If an exposure has several files, its camera is the one at ``truth_at``. If each file has a
    pose, the job gets all poses.

    Args:
        jobs: all jobs of the run.
        path: the file, or COLMAP's folder; None leaves the jobs unchanged.
        settings: the camera settings of all renders.
        truth_at: the moment of an exposure whose camera is used; "all" and "rows" use the middle.

    Raises:
        RequestError: the file cannot be read, is in an unknown format, or has no view of any job.
    """
    if path is None:
        return list(jobs)
    views = ViewIndex(read_views(path))
    name_counts = Counter(PurePosixPath(stem_of(job.key)).name for job in jobs)
    assigned = []
    for job in jobs:
        try:
            subframes = () if job.is_panorama else job.subframes
            files = [stem_of(str(PurePosixPath(job.key).with_name(p.name))) for p in subframes]
            name = stem_of(job.key)
            if job.is_panorama and not views.get(name, name_counts):
                name = stem_of(str(PurePosixPath(job.key).with_name(job.path.name)))
            views_of_files = [views.find(name, name_counts)]
            views_of_files += [view for file in files if (view := views.get(file, name_counts))]
            at = job.paths.index(job.at("middle" if truth_at in ("all", "rows") else truth_at))
            has_view_per_file = len(views_of_files) == len(job.paths) and not job.is_panorama
            with_view = _with_view(job, views_of_files[at if has_view_per_file else 0], settings)
            assigned.append(
                _with_motion(with_view, views_of_files)
                if files and has_view_per_file
                else with_view
            )
        except RequestError as error:
            assigned.append(replace(job, problem=f"--poses {path}: {error}"))
    if all(job.problem for job in assigned):
        more = f"; none of the {len(assigned)} images has a view" if len(assigned) > 1 else ""
        raise RequestError(f"{assigned[0].path}: {assigned[0].problem}{more}")
    return assigned


def _with_view(job: Job, view: View, settings: RenderCamera) -> Job:
    """Return a job with the values of a view.

    Raises:
        RequestError: the view is not valid, or contradicts the configuration or the manifest.
    """
    with contextlib.suppress(ImageError):  # the run reports it; a render at a URL is not here yet
        if view.needs_size:
            view = view.with_size(*display_size(job.path))
    try:
        if view.problem:
            raise RequestError(view.problem)
        checked = make_model(RENDER, view.values)
    except RequestError as error:
        raise RequestError(f"view {view.name}: {error}") from None
    row_values = job.values.get(RENDER, {})
    others = {**settings.model_dump(), **row_values}
    for key, value in checked.model_dump(include=set(view.values)).items():
        other = others.get(key)
        if other is not None and not np.array_equal(np.array(other), np.array(value)):
            place = job.location if key in row_values else "the configuration"
            raise RequestError(
                f"view {view.name} has {key} {value}, but {place} has {RENDER}.{key} {other}; "
                "remove one of them"
            )
    values = {**job.values, RENDER: {**row_values, **view.values}}
    return replace(job, values=values, size=view.size)


def _with_motion(job: Job, views: Sequence[View]) -> Job:
    """Return a job with the poses of all its files, if its camera moves during the exposure.

    Raises:
        RequestError: a view is not valid.
    """
    poses = []
    for view in views:
        if view.problem:
            raise RequestError(f"view {view.name}: {view.problem}")
        poses.append([view.values.get("rotation"), view.values.get("translation")])
    if poses[0][0] is None or all(pose == poses[0] for pose in poses):
        return job
    return replace(job, values={**job.values, RENDER: {**job.values[RENDER], "motion": poses}})


class ViewIndex:
    """The views of a file, looked up by the paths of renders without extensions."""

    def __init__(self, views: Sequence[View]) -> None:
        self._by_path: dict[str, list[View]] = defaultdict(list)
        for view in views:
            self._by_path[stem_of(view.name)].append(view)
        self._by_end: dict[str, list[str]] = defaultdict(list)
        for stem in self._by_path:
            parts = stem.split("/")
            for first in range(len(parts)):
                self._by_end["/".join(parts[first:])].append(stem)
        self._ends = sorted(self._by_end)

    def get(self, stem: str, name_counts: Mapping[str, int]) -> View | None:
        """Return the view that :meth:`find` returns, or None if there is none or several."""
        try:
            return self.find(stem, name_counts)
        except RequestError:
            return None

    def find(self, stem: str, name_counts: Mapping[str, int]) -> View:
        """Return the view of a render.

        Args:
            stem: the path of the render, without extension.
            name_counts: the number of renders for each file name, without extension.

        Raises:
            RequestError: there is no view of this render, or there are several.
        """
        name = PurePosixPath(stem).name
        is_named = stem not in self._by_path and (stem == name or stem not in self._by_end)
        found = [stem] if stem in self._by_path else self._by_end.get(name if is_named else stem)
        if not found:
            place = bisect_left(self._ends, name)
            ends = self._ends[max(place - 2, 0) : place + 2]
            similar = dict.fromkeys(self._by_end[end][0] for end in ends)
            raise RequestError(
                f"this file has no view {stem}; the most similar names are {', '.join(similar)}"
            )
        if len(found) > 1:
            raise RequestError(
                f"{stem} may be any of the views {', '.join(found[:3])}; choose an input folder "
                "whose relative paths match those of the views"
            )
        if is_named and name_counts[name] > 1:
            raise RequestError(
                f"this file has no view {stem}, and its view {found[0]} may belong to any of the "
                f"{name_counts[name]} images called {name}; add their folders to the names of the "
                "views"
            )
        views = self._by_path[found[0]]
        if any(view != views[0] for view in views):
            raise RequestError(
                f"this file has {len(views)} different views called {views[0].name}; keep one"
            )
        return views[0]


def stem_of(name: str) -> str:
    """Return the normalized path of an image without its extension.

    >>> stem_of("./images/frame.0001"), stem_of("a/b.exr"), stem_of("../x/c.png")
    ('images/frame.0001', 'a/b', '../x/c')
    """
    return EXTENSION.sub("", os.path.normpath(name.replace("\\", "/")))
