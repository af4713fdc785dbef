"""Build clpipe-blender.zip, a Blender extension that develops renders (see docs/datasets.md).

Its source is tools/blender/source. The zip contains wheels of clpipe, built from the checkout, and
of its dependencies, chosen by pip for the machine that this runs on.

Usage: tools/run blender extension [-o clpipe-blender.zip]
"""

import json
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import clpipe
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.files import built_in_configs
from clpipe.chain.settings import Settings
from clpipe.chain.toml import value_text
from clpipe.commands.cameras import make_and_model
from tools import ROOT
from tools.shared.options import parser_of

SOURCE = ROOT / "tools" / "blender" / "source"
# For each Python, the first Blender that has it, and the first that no longer has it.
BLENDERS = {"3.11": ("4.2.0", "5.1.0"), "3.13": ("5.1.0", None)}
# Packages that Blender ships, perhaps in other versions. A wheel would replace Blender's own for
# all add-ons, and NumPy 2 breaks add-ons compiled for NumPy 1. So they go into a private folder,
# which only clpipe's process has on its path.
PRIVATE = {"numpy", "openimageio"}


def manifest(python: str, wheels: list[str]) -> dict[str, Any]:
    """Return the contents of blender_manifest.toml.

    Args:
        python: the version of Blender's Python.
        wheels: their file names.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    first, end = BLENDERS[python]
    return {
        "schema_version": "1.0.0",
        "id": "clpipe",
        "version": clpipe.__version__,
        "name": "clpipe",
        "tagline": "Put renders through a camera: raw, sensor noise, development",
        "maintainer": "The clpipe project",
        "type": "add-on",
        "tags": ["Camera", "Render"],
        "blender_version_min": first,
        **({"blender_version_max": end} if end else {}),
        "license": [f"SPDX:{project['license']}"],
        "platforms": [sysconfig.get_platform().replace("x86_64", "x64")],
        "wheels": [f"./wheels/{name}" for name in wheels],
        "permissions": {"files": "Write linear renders and pictures next to the render"},
    }


def choices() -> dict[str, Any]:
    """Return the panel's choices: clpipe's cameras and configurations, and its defaults."""
    return {
        "cameras": {name: make_and_model(load_camera(name)) for name in built_in_cameras()},
        "looks": [*built_in_configs()],
        "look": "default",
        "iso": int(Settings().iso),
        "seed": Settings().seed,
    }


def collect_wheels(folder: Path, python: str) -> list[Path]:
    """Put the wheels of clpipe and its dependencies into a folder, and return their paths.

    Raises:
        CalledProcessError: pip failed, and printed the reason.
    """
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, ROOT], check=True)
    (own,) = folder.glob("*.whl")
    arguments = ["--only-binary=:all:", f"--python-version={python}", "-d", folder, own]
    subprocess.run([*pip, "download", *arguments], check=True)
    return sorted(folder.glob("*.whl"))


def build(output: Path, python: str, wheels: list[Path]) -> None:
    """Write the extension."""
    private = [wheel for wheel in wheels if wheel.name.partition("-")[0].lower() in PRIVATE]
    shared = [wheel for wheel in wheels if wheel not in private]
    with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as archive:
        names = [wheel.name for wheel in shared]
        lines = (f"{k} = {value_text(v)}\n" for k, v in manifest(python, names).items())
        archive.writestr("blender_manifest.toml", "".join(lines))
        archive.writestr("choices.json", json.dumps(choices(), indent=1))
        archive.write(ROOT / "LICENSE", "LICENSE")
        for path in sorted(SOURCE.glob("*.py")):
            archive.write(path, path.name)
        for wheel in shared:
            archive.write(wheel, f"wheels/{wheel.name}", zipfile.ZIP_STORED)
        for wheel in private:
            with zipfile.ZipFile(wheel) as packed:
                for name in packed.namelist():
                    if not name.endswith("/"):
                        archive.writestr(f"private/{name}", packed.read(name))


def main() -> int:
    """Build the extension, and return the exit status."""
    parser = parser_of(__doc__)
    path = Path("clpipe-blender.zip")
    parser.add_argument("-o", "--output", type=Path, default=path, help="the extension")
    text = "Blender's Python version: 3.11, or 3.13 from Blender 5.1 on"
    parser.add_argument("--python", choices=BLENDERS, default="3.11", help=text)
    options = parser.parse_args()
    if not options.output.absolute().parent.is_dir():
        parser.error(f"{options.output}: the parent folder does not exist; create it")
    with tempfile.TemporaryDirectory() as folder:
        try:
            wheels = collect_wheels(Path(folder), options.python)
        except subprocess.CalledProcessError as error:
            return error.returncode
        build(options.output, options.python, wheels)
    print(f"{options.output}: {options.output.stat().st_size / 1e6:.0f} MB, {len(wheels)} wheels")
    return 0


if __name__ == "__main__":
    sys.exit(main())
