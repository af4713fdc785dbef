"""Options that say which images are read, and how."""

import click

from clpipe.commands.options import EXISTING
from clpipe.images.pixels import MAX_PIXELS, USUAL_MAX_PIXELS
from clpipe.images.read import TRANSFERS

transfer_option = click.option(
    "--transfer",
    type=click.Choice(list(TRANSFERS), case_sensitive=False),
    help="The transfer curve of renders in whole numbers (PNG, TIFF and others).",
)

layer_option = click.option(
    "--layer", metavar="NAME", help="The layer or part of an EXR that is the picture."
)

max_pixels_option = click.option(
    "--max-pixels",
    default=USUAL_MAX_PIXELS,
    show_default=True,
    type=click.IntRange(1, MAX_PIXELS),
    metavar="N",
    help="Refuse larger images, before memory is taken.",
)

poses_option = click.option(
    "--poses",
    type=EXISTING,
    metavar="FILE",
    help="The camera and the pose of each render: a cameras.json, a transforms.json (NeRF, "
    "nerfstudio), or a folder with COLMAP's text model. Those of the pictures are written to "
    "OUT/cameras.json, OUT/transforms.json and OUT/sparse/0; see clpipe poses.",
)

annotations_option = click.option(
    "--annotations",
    type=EXISTING,
    metavar="PATH",
    help="COCO's, BOP's or KITTI's annotations of renders: a JSON file of COCO's, a scene_gt.json, "
    "or a folder of labels. They go through distortion, resizing and patches as the pixels do, "
    "into OUT.",
)

exclude_option = click.option(
    "--exclude",
    multiple=True,
    metavar="GLOB",
    help="Leave out what folders and globs would give: files and folders whose name, or path in "
    "the input folder, matches; may be repeated.",
)
