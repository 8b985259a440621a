"""The report as one HTML file."""

import json
import re
from html.parser import HTMLParser

import plotly.graph_objects as go
import pytest

from pnet.reporting.page import PageContent, page_html, write_page
from pnet.reporting.scene_view import scene_figure
from pnet.reporting.training_curves import curve_figure, training_figure


class Elements(HTMLParser):
    """Tags with their attributes, and the text outside of scripts and styles."""

    def __init__(self, page):
        super().__init__()
        self.found, self.text, self.open = [], [], None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self.open = tag

    def handle_data(self, data):
        if self.open not in ("script", "style"):
            self.text.append(data)


@pytest.fixture
def content():
    training = training_figure({"train/loss": ([0, 10], [1.0, 0.1])})
    return PageContent(
        title="TN34 <b>report</b>",
        subtitle="3 scenes & more",
        metrics=[("AP", "0.812", "1 is <perfect>."), ("Axis error", "–", "Mean angle.")],
        scenes=[("scene <1>", go.Figure(go.Scatter3d(x=[0], y=[0], z=[0], name="</script><b>")))],
        precision_recall=curve_figure([1.0, 0.5], [0.0, 1.0], 0.5),
        training=training,
        settings="part: <tn34>\nseed: 0",
        provenance=[("command", "pnet-train seed=0 && echo <done>")],
    )


def test_text_from_data_is_escaped(content):
    page = page_html(content)
    for text in ("<b>report", "<perfect>", "scene <1>", "<tn34>", "<done>"):
        assert text not in page
        assert text in "".join(Elements(page).text)
    assert "3 scenes &amp; more" in page


def test_nothing_in_a_figure_can_end_the_script(content):
    page = page_html(content)
    assert page.count("</script>") == page.count("<script>") == 2
    assert "</script><b>" not in page


def test_nothing_is_loaded(content):
    page = page_html(content)
    elements = Elements(page).found
    tags = {tag for tag, _ in elements}
    assert not tags & {"link", "img", "iframe", "object", "embed", "audio", "video", "base"}
    assert not [attrs for _, attrs in elements if {"src", "href", "srcset"} & set(attrs)]
    style = re.search("<style>(.*?)</style>", page, re.DOTALL).group(1)
    assert "url(" not in style and "@import" not in style
    (policy,) = [a["content"] for _, a in elements if "http-equiv" in a]
    assert policy.startswith("default-src 'none'") and "http" not in policy


def test_plotly_is_carried_once_however_many_figures(content):
    page = page_html(content)
    assert page.count("plotly.js v") == 1
    assert len(page) < 5_500_000
    places = [attrs["id"] for _, attrs in Elements(page).found if attrs.get("class") == "plot"]
    assert places == ["figure-0", "figure-1", "figure-2"]
    assert [place for place in places if f'draw("{place}", ' in page] == places


def test_figures_are_whole_json(content):
    page = page_html(content)
    figures = [json.loads(found) for found in re.findall(r'^draw\("[^"]+", (.*)\);$', page, re.M)]
    assert [figure["data"][0]["type"] for figure in figures] == ["scatter3d", "scatter", "scatter"]
    assert figures[0]["data"][0]["name"] == "</script><b>"


def test_logo_and_cloud_are_switched_off(content):
    config = json.loads(re.search(r"const config = (\{.*?\});", page_html(content)).group(1))
    assert config["displaylogo"] is False
    assert config["showSendToCloud"] is False
    assert config["plotlyServerURL"] == ""


def test_what_is_missing_leaves_no_empty_section(content):
    bare = PageContent(
        title="t",
        subtitle="",
        metrics=[],
        scenes=[],
        precision_recall=content.precision_recall,
        training=None,
        settings="",
        provenance=[],
    )
    page = page_html(bare)
    assert "<h2>Scenes</h2>" not in page
    assert "<h2>How it was made</h2>" not in page
    assert page.count('class="plot"') == 1


def test_a_scene_without_points_says_so_on_the_page(empty_scene, nothing, flange, content):
    figure = scene_figure(empty_scene, nothing, flange)
    page = page_html(PageContent(**{**vars(content), "scenes": [("empty", figure)]}))
    assert "this scene has no points" in page
    assert "nothing was found" in page


def test_the_file_is_written_whole(content, tmp_path):
    write_page(tmp_path / "report.html", content)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == page_html(content)
    assert len(list(tmp_path.iterdir())) == 1
