"""A page in a real browser: does it fit, are its images whole, what does the browser say of it?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from devtools import browser

MEASURE = """(async () => {
  document.querySelectorAll("details").forEach(part => part.open = true);
  await Promise.all([...document.images].map(image => image.decode().catch(() => null)));
  const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const boxes = [...document.querySelectorAll("table, figure")].map(part => part.getBoundingClientRect());
  return {
    overlaps: boxes.filter((box, i) => boxes.slice(i + 1).some(other => overlap(box, other))).length,
    shown: document.documentElement.scrollWidth, width: document.documentElement.clientWidth,
    images: document.images.length, broken: [...document.images].filter(image => !image.naturalWidth).length};
})()"""


def measure_page(page: Path, widths_px: Sequence[int]) -> list[dict[str, Any]]:
    """What the page measures in windows of these widths, and under `said` what the browser complains of."""
    measured = []
    with browser(page.parent / "profile") as window:
        for width_px in widths_px:
            tab = window.tab()
            tab.resize(width_px, 800)
            tab.open(page.as_uri())
            measured.append(tab.run(MEASURE) | {"said": tab.said})
    return measured
