"""Train small denoisers on simulated pictures, and test them on real cameras' pictures.

    sh tools/train_on_real RENDER|PHOTO... --real FOLDER [-c LOOK]... [--iso LOW HIGH] [-o OUT]

All regimes use the same networks, steps, content, and batches of 16 patches of 64x64. They differ
in the noise:

- clpipe: pictures that clpipe develops, with their development without noise.
- awgn: Gaussian noise with a sigma of 0 to 55 levels on that development.
- iid: Gaussian noise with the strength of clpipe's noise in each picture.
- real: the pictures of --pairs, with the real noise of another camera.

--network selects the networks. Each is trained on all regimes:

- unet: a U-Net of 118,000 parameters (Ronneberger et al. 2015). It is the default.
- resnet: three residual blocks on pixels folded 2x2, with 115,000 parameters.

FOLDER contains pictures of a real camera and means of many pictures of the same scene:
NAME_real.png and NAME_mean.png, or JPEG. RENDERs are linear (EXR). clpipe first converts a PHOTO
(PNG, JPEG) back to a raw. A LOOK is a configuration, for example from clpipe match; several looks
get equal shares. --iso sets the range of the ISO. Without --iso, the look sets it; a single ISO
becomes the range from half to double.
"""

import sys
from pathlib import Path

from clpipe.base.errors import ClpipeError
from tools.shared.options import count_of, parser_of
from tools.shared.pairs import find_pairs

REGIMES = ("clpipe", "awgn", "iid", "real")


def main() -> None:
    """Check the options, and train."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("inputs", nargs="+", type=Path, metavar="RENDER|PHOTO")
    add("--real", nargs="+", type=Path, required=True, metavar="FOLDER")
    add("-c", "--config", action="append", metavar="LOOK", help="[training]")
    add("--iso", nargs=2, type=float, metavar=("LOW", "HIGH"))
    add("--pairs", nargs="+", type=Path, metavar="FOLDER", help="pairs for the regime real")
    add("--regimes", nargs="+", choices=REGIMES, default=REGIMES[:3], help="[%(default)s]")
    add("--network", nargs="+", choices=("unet", "resnet"), default=["unet"], help="[unet]")
    add("--steps", type=count_of, default=2000, help="steps of training [2000]")
    add("--seeds", type=count_of, default=2, help="number of trainings [2]")
    add("-o", "--output", type=Path, default=Path("trained"), help="[trained]")
    options = parser.parse_args()
    if ("real" in options.regimes) != bool(options.pairs):
        parser.error("the regime real needs --pairs FOLDER, and no other regime uses it")
    pairs = [pair for folder in options.real for pair in find_pairs(folder)]
    means = {pair.mean.resolve(): pair.name for pair in pairs}
    trained_on = [path for folder in options.pairs or () for path in folder.glob("*")]
    for path in (*options.inputs, *trained_on):
        for mean, name in means.items():
            if path.resolve() in (mean, *mean.parents):
                parser.error(f"{path} is in the test set ({name}); do not train on it")

    from tools.training.on_real import run  # PyTorch is missing, or takes seconds to load

    run(options, pairs)


if __name__ == "__main__":
    try:
        main()
    except (ClpipeError, OSError) as error:
        sys.exit(f"error: {error}")
