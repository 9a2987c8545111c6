"""The page as MLflow shows an artifact: in a frame of a blob's address that may run scripts and nothing else."""

import base64
import json
from pathlib import Path

import pytest
from devtools import BROWSER, browser

from negopipe.report.page import FigureItem, Provenance, Section, build_page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no browser")]

PROBE = """<script>
const wait = ms => new Promise(done => setTimeout(done, ms));
addEventListener("load", async () => {
  while (innerHeight < 300) await wait(20);  // the frame has no size at first
  const before = scrollY, link = document.querySelector("nav a:nth-of-type(2)");
  link.click();
  await wait(200);
  const {top} = document.querySelector(link.getAttribute("href")).getBoundingClientRect();
  parent.postMessage({before, after: scrollY, top}, "*");
});
</script>"""
FRAME = """<iframe sandbox="allow-scripts" style="width: 700px; height: 400px"></iframe>
<script>
onmessage = event => window.said = JSON.stringify(event.data);
const page = new TextDecoder().decode(Uint8Array.from(atob("{page}"), letter => letter.charCodeAt(0)));
document.querySelector("iframe").src = URL.createObjectURL(new Blob([page], {{type: "text/html"}}));
</script>"""


def test_a_link_leads_to_its_section(tmp_path: Path) -> None:
    svg = b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" width="400" height="900"></svg>'
    sections = [Section(name, "", [FigureItem("A figure", "Seen.", svg)]) for name in ("One", "Two")]
    page = build_page("framed", [("So it is.", "")], [], [], sections, Provenance("", "", "", {}), None)
    framed = tmp_path / "framed.html"
    framed.write_text(FRAME.format(page=base64.b64encode((page + PROBE).encode()).decode()))
    with browser(tmp_path / "profile") as window:
        tab = window.tab()
        tab.open(framed.as_uri())
        seen = json.loads(tab.wait("window.said"))
    assert seen["before"] == 0
    assert seen["after"] > 100
    assert abs(seen["top"]) < 2
