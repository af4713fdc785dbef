"""``clpipe poses``: write the cameras of a run's pictures for COLMAP, nerfstudio and others."""

from pathlib import Path

import click

from clpipe.base.errors import RequestError
from clpipe.commands.options import EXISTING, Command, json_option
from clpipe.commands.printing import show_json
from clpipe.outputs.camera_files import write_camera_files


@click.command("poses", cls=Command)
@click.argument("folder", metavar="OUT", type=EXISTING)
@json_option
def poses(folder: Path, as_json: bool) -> None:
    """Write the cameras and poses of a run's pictures, for COLMAP, nerfstudio and other programs.

    OUT is the output directory of clpipe run, finished or not. Only its sidecars are read. The
    cameras after distortion and resizing are written to OUT/cameras.json, OUT/transforms.json (for
    NeRF and nerfstudio) and OUT/sparse/0 (COLMAP's text model). clpipe run --poses also writes
    these files, except for tars and for the parts of a run (--shard).

    \b
    clpipe run renders/ -o out --poses renders/cameras.json --shard 1/2
    clpipe run renders/ -o out --poses renders/cameras.json --shard 2/2
    clpipe poses out
    """
    if not folder.is_dir():
        raise RequestError(
            f"{folder}: this is a file, not a directory; name the output directory of a run"
        )
    written = write_camera_files(folder)
    if not written.files:
        reasons = "; ".join(written.warnings) or "there is no sidecar of a picture"
        raise RequestError(
            f"{folder}: no cameras are known: {reasons}; run with --poses FILE, or set "
            "render.focal_length and render.sensor_width, or render.fx"
        )
    if as_json:
        named = {"files": written.files, "pictures": written.pictures, "warnings": written.warnings}
        show_json({"folder": str(folder), **named})
        return
    for line in written.lines(folder):
        click.echo(line)
