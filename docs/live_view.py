"""Takes docs/view.webp: the live view of the bundled arm in Chromium, while a plant and a loop run.

    .venv/bin/python docs/live_view.py

A browser that draws without a graphics card takes every core, so plant and loop ask for a real-time priority: run it where they get one.
"""

import io
import shutil
import subprocess
import time
from pathlib import Path

import viser
from PIL import Image
from playwright.sync_api import sync_playwright

from nearl.view import Loop, Page

ROOT = Path(__file__).resolve().parents[1]
NEARL = ROOT / "target/release/nearl"
NAME, SIZE, PORT = "arm", (1120, 900), 8091
DRAWN = 45.0  # [s] until the page has been drawn in software


def main() -> None:
    """Writes the picture."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    plant = subprocess.Popen([NEARL, "plant", "Panda-reach", "--name", NAME, "--priority", "40"], **quiet)
    loop = subprocess.Popen([NEARL, "run", ROOT / "examples/snapshots/panda-reach.safetensors", "--plant", NAME], **quiet)
    source = Loop(NAME, None)
    server = viser.ViserServer(host="127.0.0.1", port=PORT, label=f"NEARL: {NAME}", verbose=False)
    page = Page(server, source)
    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium") or shutil.which("google-chrome"), args=arguments)
            tab = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            tab.goto(f"http://127.0.0.1:{PORT}")
            end, before, shown = time.monotonic() + DRAWN, 0, 0
            while shown < 8:  # pictures of an episode that has just begun: its goal is far away
                picture = source.next(0.05)
                if picture is not None:
                    page.show(picture)
                    before = picture.episode if time.monotonic() < end else before
                    shown += picture.episode > before
            tab.wait_for_selector(".nearl")
            tab.add_style_tag(content=".mantine-Notification-root{display:none}")  # it says that there is no graphics card
            shot = Image.open(io.BytesIO(tab.screenshot(timeout=180_000)))
            browser.close()
    finally:
        server.stop()
        source.close()
        for process in (loop, plant):
            process.terminate()
            process.wait(timeout=30)
    shot.convert("RGB").save(ROOT / "docs/view.webp", quality=80, method=6)


if __name__ == "__main__":
    main()
