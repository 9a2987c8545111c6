"""A page in a real browser, where one is installed: does it fit, are its images whole, what does the browser say?"""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
PROBE = """<script>
document.querySelectorAll("details").forEach(part => part.open = true);
const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
const boxes = [...document.querySelectorAll("table, figure")].map(part => part.getBoundingClientRect());
addEventListener("load", () => parent.postMessage({
  overlaps: boxes.filter((box, i) => boxes.slice(i + 1).some(other => overlap(box, other))).length,
  shown: document.documentElement.scrollWidth, width: document.documentElement.clientWidth,
  images: document.images.length, broken: [...document.images].filter(image => !image.naturalWidth).length}, "*"));
</script>"""
FRAME = """<iframe style="width: {width}px; height: 800px; border: 0" srcdoc="{page}"></iframe><pre id="said"></pre>
<script>onmessage = event => document.getElementById("said").textContent = JSON.stringify(event.data)</script>"""


def in_browser(page: Path, width_px: int) -> tuple[dict[str, int], str]:
    """What the page measures in a window of that width, and what the browser says of it."""
    framed = page.with_name(f"framed_{width_px}.html")
    framed.write_text(FRAME.format(width=width_px, page=html.escape(page.read_text() + PROBE)))
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]
    command += ["--virtual-time-budget=10000", f"--user-data-dir={page.parent / 'profile'}", framed.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    said = re.search(r'<pre id="said">(.+?)</pre>', done.stdout)
    assert said, done.stderr
    return json.loads(html.unescape(said[1])), done.stderr
