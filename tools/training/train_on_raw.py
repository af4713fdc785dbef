"""Train small raw denoisers with three noise models, and test them on the full model's noise.

    sh tools/run training train_on_raw RENDER... --test RENDER... [--camera NAME] [--iso LOW HIGH]

Renders become clean raws of a camera in dim light. clpipe.torch.RawNoise adds noise during
training, and both raws are brightened again. Each regime trains the same network, a U-Net of
118,000 parameters, with the same steps and patches:

- full: all noise of the camera's profile except errors of the black level, which dark frames
  remove. It has shot noise, tails of the read noise, rows, rounding and clipping.
- poisson-gaussian: shot noise and Gaussian read noise of the same variance.
- iid: Gaussian noise of the same strength in each patch.

The test uses raws of held-out renders with the full noise. It does not use real pairs of raws. The
table therefore shows the value of each component for a sensor that has all of them. KLD is the
divergence of the histogram of dark noise from the full model's, in nats.
"""

import sys
from pathlib import Path

from clpipe.base.errors import ClpipeError
from tools.shared.options import count_of, parser_of


def main() -> None:
    """Check the options, and train."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("renders", nargs="+", type=Path, metavar="RENDER")
    add("--test", nargs="+", type=Path, required=True, metavar="RENDER")
    add("--camera", default="sony-a7s2", help="[sony-a7s2]")
    add("--iso", nargs=2, type=float, default=(1600, 25600), metavar=("LOW", "HIGH"))
    add("--steps", type=count_of, default=2000, help="steps of training [2000]")
    add("--seeds", type=count_of, default=2, help="number of trainings [2]")
    add("-o", "--output", type=Path, default=Path("raw.json"), help="[raw.json]")
    options = parser.parse_args()
    both = {path.resolve() for path in options.renders} & {path.resolve() for path in options.test}
    if both:
        parser.error(f"--test: {min(both)} is also a training render; remove it from one list")

    from tools.training.on_raw import run  # PyTorch is missing, or takes seconds to load

    run(options)


if __name__ == "__main__":
    try:
        main()
    except (ClpipeError, OSError) as error:
        sys.exit(f"error: {error}")
