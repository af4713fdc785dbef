"""Finds the camera of each render of a run in a file that has those of all."""

import os
import re
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.chain.keys import RENDER
from clpipe.chain.methods import make_model
from clpipe.chain.options import Moments
from clpipe.chain.render_camera import RenderCamera
from clpipe.inputs.find import Job
from clpipe.inputs.render_cameras import View, read_views

ENDING = re.compile(r"\.[A-Za-z]\w{1,4}$")  # of an image's name; frame.0001 has none


def with_views(
    jobs: Sequence[Job], path: Path | None, settings: RenderCamera, truth_at: Moments = "middle"
) -> list[Job]:
    """The jobs of a run, each with the camera that a file has for it.

    A view and a render belong together where their paths are equal but for their endings, that of
    the render below the input folder; else where the end of the view's path is the render's; else
    by the names of the files, where no other view and no other render is called so. A job without a
    view, or with one that cannot be, has a ``problem``. Of an exposure of several files the camera
    is that of one moment; where each file has a pose of its own, it has all of them, too.

    Args:
        jobs: all of the run.
        path: the file, or COLMAP's folder; None leaves the jobs as they are.
        settings: what holds for all renders.
        truth_at: which moment of an exposure the camera is that of; "all" is its middle.

    Raises:
        RequestError: the file cannot be read, or is of none of the forms, or has a view for no job.
    """
    if path is None:
        return list(jobs)
    views = Views(read_views(path))
    called = Counter(PurePosixPath(stem_of(job.key)).name for job in jobs)
    given = []
    for job in jobs:
        try:
            several = () if job.around else job.subframes
            files = [stem_of(str(PurePosixPath(job.key).with_name(p.name))) for p in several]
            own_name = stem_of(job.key)
            if job.around and not views.get(own_name, called):
                own_name = stem_of(str(PurePosixPath(job.key).with_name(job.path.name)))
            of_files = [views.find(own_name, called)]
            of_files += [view for file in files if (view := views.get(file, called))]
            at = job.paths.index(job.at("middle" if truth_at == "all" else truth_at))
            is_whole = len(of_files) == len(job.paths) and not job.around
            own = _with_view(job, of_files[at if is_whole else 0], settings)
            given.append(_with_motion(own, of_files) if files and is_whole else own)
        except RequestError as error:
            given.append(replace(job, problem=f"--poses {path}: {error}"))
    if all(job.problem for job in given):
        more = f"; and so for all {len(given)} images" if len(given) > 1 else ""
        raise RequestError(f"{given[0].path}: {given[0].problem}{more}")
    return given


def _with_view(job: Job, view: View, settings: RenderCamera) -> Job:
    """A job with the values of a view.

    Raises:
        RequestError: the view cannot be a render's, or something else says otherwise.
    """
    try:
        if view.problem:
            raise RequestError(view.problem)
        checked = make_model(RENDER, view.values)
    except RequestError as error:
        raise RequestError(f"view {view.name}: {error}") from None
    own = job.values.get(RENDER, {})
    others = {**settings.model_dump(), **own}
    for key, value in checked.model_dump(include=set(view.values)).items():
        other = others.get(key)
        if other is not None and not np.array_equal(np.array(other), np.array(value)):
            place = job.place if key in own else "the configuration"
            raise RequestError(
                f"view {view.name} has {key} {value}, but {place} has {RENDER}.{key} {other}; "
                "leave one of them out"
            )
    values = {**job.values, RENDER: {**own, **view.values}}
    return replace(job, values=values, size=view.size)


def _with_motion(job: Job, views: Sequence[View]) -> Job:
    """A job of an exposure during which its camera moves, with the poses of its files.

    Raises:
        RequestError: a view cannot be a render's.
    """
    poses = []
    for view in views:
        if view.problem:
            raise RequestError(f"view {view.name}: {view.problem}")
        poses.append([view.values.get("rotation"), view.values.get("translation")])
    if poses[0][0] is None or all(pose == poses[0] for pose in poses):
        return job
    return replace(job, values={**job.values, RENDER: {**job.values[RENDER], "motion": poses}})


class Views:
    """The views of a file, to be found by the paths of renders without their endings."""

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

    def get(self, stem: str, called: Mapping[str, int]) -> View | None:
        """As :meth:`find`; None where there is none, or are several."""
        try:
            return self.find(stem, called)
        except RequestError:
            return None

    def find(self, stem: str, called: Mapping[str, int]) -> View:
        """The view of a render, by its path without its ending.

        Args:
            stem: the path.
            called: how many renders have the name of a file, without its ending.

        Raises:
            RequestError: there is none, or there are several.
        """
        name = PurePosixPath(stem).name
        is_named = stem not in self._by_path and (stem == name or stem not in self._by_end)
        found = [stem] if stem in self._by_path else self._by_end.get(name if is_named else stem)
        if not found:
            place = bisect_left(self._ends, name)
            ends = self._ends[max(place - 2, 0) : place + 2]
            near = dict.fromkeys(self._by_end[end][0] for end in ends)
            raise RequestError(f"has no view {stem}; the nearest are {', '.join(near)}")
        if len(found) > 1:
            raise RequestError(
                f"{stem} may be any of the views {', '.join(found[:3])}; name the input folder so "
                "that paths below it are theirs"
            )
        if is_named and called[name] > 1:
            raise RequestError(
                f"has no view {stem}, and {called[name]} images are called {name}, so that its "
                f"view {found[0]} may be another's"
            )
        views = self._by_path[found[0]]
        if any(view != views[0] for view in views):
            raise RequestError(f"view {views[0].name} is there {len(views)} times, each another")
        return views[0]


def stem_of(name: str) -> str:
    """The path of an image without its ending.

    >>> stem_of("./images/frame.0001"), stem_of("a/b.exr"), stem_of("../x/c.png")
    ('images/frame.0001', 'a/b', '../x/c')
    """
    return ENDING.sub("", os.path.normpath(name.replace("\\", "/")))
