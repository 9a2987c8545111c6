"""The page: honest headlines, one self-contained file, nothing fetched from elsewhere."""

import base64
import json
import re
from pathlib import Path

import pytest
import yaml
from measured import FIXED_S, measures, versus
from pydantic import TypeAdapter, ValidationError

from negopipe.evaluation.hypothesis import Claim, Finding
from negopipe.report.headlines import headlines
from negopipe.report.page import (
    FigureItem,
    Provenance,
    ReportConfig,
    Results,
    Section,
    build_page,
    chapters,
    data_uri,
    settings_in_order,
)

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
SVG = b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'
CONF = Path(__file__).resolve().parents[2] / "conf" / "report" / "html.yaml"


RESULTS = Results(
    {
        "yield": {"adaptive": measures(0.9, 0.1, 14.0), "fixed_0": measures(0.0, 1.0, None)},
        "push": {"adaptive": measures(1.0, 0.0, 8.0), "fixed_0": measures(1.0, 0.0, 9.5)},
    },
    {"yield": {"fixed_0": versus(-0.9)}, "push": {"fixed_0": versus(0.0, time_s=1.5)}},
    {"yield": {}, "push": {}},
)
CLAIM = Claim(
    4,
    "Nobody <else> arrives",
    "all others fail",
    [
        Finding("success of fixed 4 s [%]", 69.0, 62.3, 75.0, "does not hold", -64.0),
        Finding("success of fixed 6 s [%]", 100.0, 98.1, 100.0, "does not hold", -95.0),
    ],
)


def make_page(name: str = "yield", results: Results = RESULTS) -> str:
    items = [FigureItem("A figure", "Upwards is <good>.", SVG), FigureItem("A film", "Left is left.", PNG, PNG)]
    sections = [Section("First part", "What it shows.", items), Section("Second part", "", [])]
    provenance = Provenance("python -m negopipe +experiment=yield", "7", "seed: 7\n", {"torch": "2.13.0"})
    verdicts = headlines(results.evaluation, results.versus, FIXED_S)
    opening = FigureItem("The opening", "Up is up.", PNG, PNG)
    return build_page(name, verdicts, chapters(results, FIXED_S), [CLAIM], sections, provenance, opening)


def test_the_page_holds_all_parts() -> None:
    page = make_page()
    for text in ("First part", "Second part", "What it shows.", "A figure", "A film", "seed: 7", "2.13.0"):
        assert text in page
    assert "python -m negopipe +experiment=yield" in page
    assert page.count("<figcaption>") == 3


def test_the_page_opens_with_the_film_and_goes_on_with_the_verdict() -> None:
    page = make_page()
    assert page.index("The opening") < page.index('<p class="verdict">') < page.index("<nav")
    assert page.count("data-fastest") == 1  # in the page's markup: only the opening may run faster


def test_a_page_without_a_film_opens_with_the_verdict() -> None:
    verdicts = [("Yield: so it is.", "As here.")]
    page = build_page("push", verdicts, [], [], [], Provenance("command", "1", "", {}))
    assert "<figure" not in page
    assert "Yield: so it is." in page


def test_the_leading_setting_comes_first() -> None:
    assert settings_in_order(RESULTS.evaluation, "push") == ["push", "yield"]
    assert settings_in_order(RESULTS.evaluation, "yield") == ["yield", "push"]
    page = make_page()
    for element in ('<h3 class="setting">{}</h3>', '<p class="verdict">{}:'):
        positions = [page.index(element.format(name)) for name in ("Yield", "Push")]
        assert positions == sorted(positions)


def test_a_claim_shows_its_verdict_and_figures() -> None:
    page = make_page()
    assert '<strong class="does-not-hold">does not hold</strong> Nobody &lt;else&gt; arrives' in page
    assert "The claim holds if: all others fail." in page
    assert "<td>69.00 (62.30 to 75.00)</td><td>does not hold</td>" in page
    assert "Of 1 claims: 1 do not hold." in page
    before_the_rule = page[: page.index("The claim holds if")]
    assert "success of fixed 6 s [%]: 100.00 (98.10 to 100.00)" in before_the_rule  # the clearest against it
    assert "fixed 4 s [%]" not in before_the_rule


def test_page_is_one_file() -> None:
    page = make_page()
    links = re.findall(r'(?:src|srcset|href)="([^"]*)"', page)
    assert links
    assert all(link.startswith(("data:image/", "#")) for link in links)
    assert not re.findall(r"https?:|url\(|@import|<script .*src|<link", page)
    assert page.count("<script>") == 2  # links and films
    assert sum(link.startswith("data:") for link in links) == 5  # a figure, and two films with their stills
    assert {link[1:] for link in links if link[0] == "#"} <= set(re.findall(r'id="([^"]*)"', page))


def test_every_image_says_in_words_what_it_shows() -> None:
    for tag in re.findall(r"<img [^>]*>", make_page()):
        assert re.search(r'alt="(A figure|A film|The opening)\. [^"]+"', tag)


def test_text_is_escaped() -> None:
    page = make_page(name="<script>alert(1)</script>")
    assert "<script>alert" not in page
    assert "Upwards is &lt;good&gt;." in page


def test_data_uris_hold_the_image() -> None:
    kind, data = data_uri(PNG).split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == PNG
    assert data_uri(SVG).startswith("data:image/svg+xml;base64,")
    assert data_uri(b"GIF89a").startswith("data:image/gif;base64,")


def test_config_file_is_valid_and_wrong_values_are_not() -> None:
    values = yaml.safe_load(CONF.read_text())
    adapter = TypeAdapter(ReportConfig)
    adapter.validate_json(json.dumps(values), strict=True)
    for wrong in ({"animation_fps": 0}, {"figure_formats": ["gif"]}, {"n_animations": -1}, {"dpi": 200}):
        with pytest.raises(ValidationError):
            adapter.validate_json(json.dumps(values | wrong), strict=True)
