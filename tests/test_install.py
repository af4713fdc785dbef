"""The package as a user gets it: installed from another folder, kernels inside."""

import os
import subprocess
import sys

from tests.conftest import ROOT, STILL_LIFE


def test_the_installed_package_works_from_anywhere(tmp_path):
    target = tmp_path / "site"
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--disable-pip-version-check"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target, ROOT],
        check=True,
        cwd=tmp_path,
    )
    assert (target / "clpipe" / "kernels" / "lib" / "lanes.h").is_file()
    assert (target / "clpipe" / "camera" / "profiles" / "sony-a7r2.toml").is_file()
    code = (
        "import clpipe.engine.sources as c; print(c.kernel_folder()); "
        "from clpipe.commands.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "run", STILL_LIFE, "-o", "out"],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.startswith(str(target))
    assert (tmp_path / "out" / "still_life.jpg").is_file()
