"""Make pictures of clpipe's pages: docs/screen_report.webp and docs/screen_explore.webp.

It also makes docs/explore_iso.webp, an animation of the ISO's slider in the explorer.

    tools/run pages screens

It needs Chromium and Playwright: .venv/bin/python -m pip install playwright
"""

import hashlib
import shutil
import sys
import threading
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image

import clpipe
from clpipe.chain.request import Request
from clpipe.engine.device import open_device
from clpipe.explorer.explorer import Explorer
from clpipe.explorer.server import Server
from clpipe.inputs.find import Job
from clpipe.reports.page import html
from clpipe.reports.run import read_run
from tools import RENDER, ROOT
from tools.shared.options import parser_of

SIZE = {"width": 1366, "height": 768}
ISOS = [100 * 2 ** (step / 2) for step in range(15)]
FRAME = 300, 1200  # ms; a frame of the animation, and its first and last one
ANIMATED = 911, 512  # px


def pages_digest() -> str:
    """Return a digest of the pages' files, with which a test detects outdated screenshots."""
    digest = hashlib.sha256()
    for package in ("analysis", "explorer", "reports"):
        for path in sorted((ROOT / "clpipe" / package / "page").iterdir()):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def save_screenshot(page: Any, name: str) -> None:
    """Write a screenshot of a page."""
    path = ROOT / "docs" / f"screen_{name}.webp"
    picture = Image.open(BytesIO(page.screenshot())).convert("RGB")
    picture.save(path, quality=86, method=6, xmp=pages_digest().encode())
    print(path.relative_to(ROOT))


def report(page: Any, folder: Path) -> None:
    """Show the report of a small run."""
    out = folder / "out"
    list(clpipe.run(RENDER, out, iso=[400, 6400], truth="clean", camera="sony-a7r2"))
    path = out / "report.html"
    path.write_text(html([read_run(out)]), "utf-8")
    page.goto(f"file://{path}")
    page.locator("#look-image").select_option(index=1)
    page.get_by_role("heading", name="Compare").evaluate("e => e.scrollIntoView()")
    page.wait_for_timeout(500)
    save_screenshot(page, "report")


def explorer(page: Any) -> None:
    """Show the explorer with a render at a high ISO."""
    jobs = [Job(RENDER, RENDER.name)]
    server = Server(
        Explorer(jobs, Request.from_options(values={"iso": 6400}), open_device(None)), 0
    )
    threading.Thread(target=server.run, daemon=True).start()
    page.goto(server.address)
    page.wait_for_timeout(6000)
    save_screenshot(page, "explore")
    animate(page)


def animate(page: Any) -> None:
    """Write an animation of the page whose picture follows the ISO."""
    slider = page.get_by_label("ISO, slider")
    frames = []
    for iso in ISOS:
        slider.evaluate(
            "(e, iso) => { e.value = Math.log2(iso); e.dispatchEvent(new Event('input')); }", iso
        )
        page.wait_for_timeout(1500)
        picture = Image.open(BytesIO(page.screenshot())).convert("RGB")
        frames.append(picture.resize(ANIMATED, Image.Resampling.LANCZOS))
    path = ROOT / "docs" / "explore_iso.webp"
    durations = [FRAME[number in (0, len(frames) - 1)] for number in range(len(frames))]
    options = {"quality": 60, "method": 6, "xmp": pages_digest().encode(), "loop": 0}
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        minimize_size=True,
        **options,
    )
    print(path.relative_to(ROOT))


def main() -> None:
    """Write the pictures."""
    parser_of(__doc__).parse_args()
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        sys.exit("screens needs Playwright: .venv/bin/python -m pip install playwright")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if not chromium:
        sys.exit("screens needs Chromium (Debian: apt-get install chromium)")
    with sync_playwright() as play, TemporaryDirectory() as name:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        report(page, Path(name))
        explorer(page)
        browser.close()


if __name__ == "__main__":
    main()
