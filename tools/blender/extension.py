"""Build clpipe-blender.zip: an extension of Blender that develops its renders; see docs/blender.md.

Its source is tools/blender/source. Wheels are those of the machine that this runs on, of clpipe as
it is in the checkout and of what it depends on, as pip finds it.

Usage: tools/run blender extension [-o clpipe-blender.zip]
"""

import argparse
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
from clpipe.commands.cameras import make_and_model
from tools import ROOT

SOURCE = ROOT / "tools" / "blender" / "source"
# The first Blender that has a Python, and the first one that has it no longer.
BLENDERS = {"3.11": ("4.2.0", "5.1.0"), "3.13": ("5.1.0", None)}
# What Blender itself has, in versions that may be others. A wheel of it would take the place of
# Blender's own for all add-ons (NumPy 2 breaks what is compiled for NumPy 1), so these go into a
# folder that clpipe's process alone knows.
PRIVATE = {"numpy", "openimageio"}


def manifest(python: str, wheels: list[str]) -> dict[str, Any]:
    """What blender_manifest.toml says.

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
        "permissions": {"files": "Write linear renders and pictures beside the render"},
    }


def toml(values: dict[str, Any]) -> str:
    """Plain values, lists and tables of strings as TOML, whose strings and lists are JSON's."""
    lines = [f"{k} = {json.dumps(v)}" for k, v in values.items() if not isinstance(v, dict)]
    for name, table in values.items():
        if isinstance(table, dict):
            lines += ["", f"[{name}]", toml(table)]
    return "\n".join(lines) + "\n"


def choices() -> dict[str, Any]:
    """What the panel offers: clpipe's cameras and configurations, and its defaults."""
    return {
        "cameras": {name: make_and_model(load_camera(name)) for name in built_in_cameras()},
        "looks": [*built_in_configs()],
        "look": "default",
        "iso": int(Settings().iso),
        "seed": Settings().seed,
    }


def collect_wheels(folder: Path, python: str) -> list[Path]:
    """The wheels of clpipe and all that it needs, in a folder.

    Raises:
        CalledProcessError: pip failed; it has said why.
    """
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, ROOT], check=True)
    (own,) = folder.glob("*.whl")
    wanted = ["--only-binary=:all:", f"--python-version={python}", "-d", folder, own]
    subprocess.run([*pip, "download", *wanted], check=True)
    return sorted(folder.glob("*.whl"))


def build(output: Path, python: str, wheels: list[Path]) -> None:
    """Write the extension."""
    private = [wheel for wheel in wheels if wheel.name.partition("-")[0].lower() in PRIVATE]
    shared = [wheel for wheel in wheels if wheel not in private]
    with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as archive:
        names = [wheel.name for wheel in shared]
        archive.writestr("blender_manifest.toml", toml(manifest(python, names)))
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
    """Build what the command line says; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("clpipe-blender.zip"), help="the extension"
    )
    parser.add_argument(
        "--python",
        choices=BLENDERS,
        default="3.11",
        help="that of Blender: 3.11, or 3.13 from Blender 5.1 on",
    )
    options = parser.parse_args()
    if not options.output.absolute().parent.is_dir():
        parser.error(f"{options.output}: its folder does not exist")
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
