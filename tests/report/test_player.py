"""The scrubber of the report's films in a real browser: the GIF's own frames, at the right time, by hand."""

import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from devtools import BROWSER, browser
from measured import FIXED_S
from PIL import Image

from negopipe.evaluation.trace import Trace
from negopipe.report.animation import animate, slides, still
from negopipe.report.page import FigureItem, Provenance, Section, build_page
from negopipe.report.scene import Scene

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser is installed")

PROBE = """(async () => {
// CRC-32 of the colours that a canvas shows, without alpha, as zlib has it.
const table = Array.from({length: 256}, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ n >>> 1 : n >>> 1;
  return n >>> 0;
});
const shown = canvas => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let crc = 0xffffffff;
  data.forEach((value, i) => { if (i % 4 < 3) crc = table[(crc ^ value) & 255] ^ crc >>> 8; });
  return (crc ^ 0xffffffff) >>> 0;
};
const films = [], later = window.setTimeout;
const found = async seek => {
  for (let ms = 0; !seek(); ms += 5) {
    if (ms > 60000) throw Error(`not in a minute: ${seek}`);
    await new Promise(done => later(done, 5));
  }
  return seek();
};
for (const figure of document.querySelectorAll(".film")) {
  figure.scrollIntoView({block: "center"});
  const canvas = await found(() => figure.querySelector("canvas"));
  const slider = figure.querySelector("input");
  const [toggle, back, forth, speed] = figure.querySelectorAll("button");
  const film = {speed: speed.textContent, playing: toggle.title, frames: [], last: Number(slider.max)};
  const at = frame => { slider.value = frame; slider.dispatchEvent(new Event("input")); };
  for (let frame = 0; frame <= film.last; frame++) {
    at(frame);
    film.frames.push(shown(canvas));
  }
  film.paused = toggle.title;
  at(1);
  film.again = shown(canvas);
  forth.click();
  film.forth = Number(slider.value);
  back.click();
  back.click();
  back.click();
  film.back = Number(slider.value);
  film.ms = 0;
  window.setTimeout = (draw, ms) => { film.ms += ms; return later(draw, 0); };  // waits are noted, not waited
  toggle.click();
  await found(() => toggle.title === "Play");
  window.setTimeout = later;
  film.ended = Number(slider.value);
  speed.click();
  film.next_speed = speed.textContent;
  films.push(film);
}
return films;
})()"""


@pytest.fixture(scope="module")
def gifs(traces: list[Trace], scene: Scene) -> list[bytes]:
    """A film of a drive of several frames, and slides with palettes of their own."""
    colors = [np.full((9, 12, 3), color, dtype=np.uint8) for color in (40, 90, 250)]
    pngs = []
    for n, picture in enumerate(colors):
        picture[n : n + 3, 2:7] = (250, 20 * n, 30)
        buffer = BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        pngs.append(buffer.getvalue())
    return [animate([traces[0], traces[2]], 0, scene, 2, FIXED_S), slides(pngs, 0.4)]


@pytest.fixture(scope="module")
def films(gifs: list[bytes], traces: list[Trace], scene: Scene, tmp_path_factory: Any) -> list[dict[str, Any]]:
    """What the browser shows of each film when its controls are used; the first one opens the page."""
    png = still(traces[:1], 0, scene, 1.0, FIXED_S)
    opening, *others = (FigureItem(f"film {i}", "Seen.", gif, png) for i, gif in enumerate(gifs))
    sections = [Section("Films", "", others)]
    page = build_page("films", [("So it is.", "")], [], [], sections, Provenance("", "", "", {}), opening)
    folder: Path = tmp_path_factory.mktemp("player")
    (folder / "page.html").write_text(page)
    with browser(folder / "profile") as window:
        tab = window.tab()
        tab.resize(1000, 900)
        tab.open((folder / "page.html").as_uri())
        found: list[dict[str, Any]] = tab.run(PROBE)
    return found


def frames(gif: bytes) -> tuple[list[int], float]:
    """Checksums of the colours of all frames, and the time until the last one begins, ms."""
    sums, start_ms = [], []
    with Image.open(BytesIO(gif)) as film:
        for frame in range(film.n_frames):  # type: ignore[attr-defined]
            film.seek(frame)
            sums.append(zlib.crc32(film.convert("RGB").tobytes()))
            start_ms.append(film.info["duration"])
    return sums, sum(start_ms[:-1])


def test_every_frame_is_that_of_the_gif(films: list[dict[str, Any]], gifs: list[bytes]) -> None:
    assert len(films) == len(gifs)
    for film, gif in zip(films, gifs, strict=True):
        assert film["frames"] == frames(gif)[0]
        assert len(set(film["frames"])) > 2


def test_a_film_plays_when_it_comes_into_view_until_it_is_touched(films: list[dict[str, Any]]) -> None:
    assert [(film["playing"], film["paused"]) for film in films] == [("Pause", "Play")] * 2


def test_frames_are_reached_in_any_order(films: list[dict[str, Any]]) -> None:
    for film in films:
        assert film["again"] == film["frames"][1]
        assert film["forth"] == 2
        assert film["back"] == 0  # and stays there


def test_a_film_runs_in_real_time_and_stops_at_its_end(films: list[dict[str, Any]], gifs: list[bytes]) -> None:
    for film, gif in zip(films, gifs, strict=True):
        speed = float(film["speed"][:-1])
        assert film["ended"] == film["last"]
        assert film["ms"] == pytest.approx(frames(gif)[1] / speed, rel=1e-6)


def test_a_long_film_at_the_top_runs_at_twice_its_speed(films: list[dict[str, Any]], gifs: list[bytes]) -> None:
    assert frames(gifs[0])[1] > 5000
    assert [(film["speed"][:-1], film["next_speed"][:-1]) for film in films] == [("2", "½"), ("1", "2")]
