"""The report of a run: one HTML file that needs nothing but a browser."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import plotly.graph_objects as go
import plotly.io
from plotly.offline import get_plotlyjs

from pnet.scenes.record_file import write_atomically

Row = tuple[str, str, str]

# nothing is ever fetched: the browser itself refuses what this does not name
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline' 'unsafe-eval'; "
    "img-src data: blob:; font-src data:; worker-src blob:; base-uri 'none'; form-action 'none'"
)
_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "showSendToCloud": False,  # plotly.js 7 offers by default to send the figure to its maker
    "plotlyServerURL": "",
    "modeBarButtonsToRemove": ["select2d", "lasso2d", "tableRotation"],
}
_STYLE = """
:root { color-scheme: light dark; --page: #f5f6f8; --card: #ffffff; --line: #e0e3e8; --text: #1b2027;
  --quiet: #5c6672; --accent: #2563c9; }
@media (prefers-color-scheme: dark) { :root { --page: #0e1116; --card: #171b22; --line: #2a303a;
  --text: #e8ecf1; --quiet: #98a2ae; --accent: #7db0ff; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--text); line-height: 1.5;
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif; }
main { max-width: 1280px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0; }
h2 { font-size: 1.2rem; margin: 40px 0 4px; }
p { margin: 4px 0 12px; }
.quiet, figcaption { color: var(--quiet); }
.cards { display: grid; gap: 12px; margin-top: 24px;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 270px), 1fr)); }
.card, figure, details { background: var(--card); border: 1px solid var(--line); border-radius: 10px; }
.card { padding: 14px 18px; }
.card h3 { margin: 0; font-size: .92rem; font-weight: 600; color: var(--quiet); }
.card strong { display: block; font-size: 1.75rem; line-height: 1.3; color: var(--accent);
  font-variant-numeric: tabular-nums; }
.card p { margin: 0; font-size: .86rem; color: var(--quiet); }
figure { margin: 0 0 20px; padding: 14px; min-width: 0; overflow: hidden; }
figcaption { padding: 0 4px 8px; overflow-wrap: anywhere; }
.scene .plot { height: clamp(320px, 75vw, min(80vh, 760px)); }
.curves { display: grid; gap: 20px; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 460px), 1fr)); }
.curves .plot { height: 520px; }
details { padding: 12px 18px; margin-top: 12px; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; font-size: .84rem; }
table { border-collapse: collapse; margin-top: 8px; }
th, td { text-align: left; vertical-align: top; padding: 3px 24px 3px 0; overflow-wrap: anywhere; }
th { color: var(--quiet); font-weight: 500; white-space: nowrap; }
"""
_DRAW = """
function draw(id, figure) {
  try {
    Plotly.newPlot(id, figure.data, figure.layout, config);
  } catch (fault) { // the others are drawn all the same
    document.getElementById(id).textContent = `This figure cannot be drawn: ${fault}`;
  }
}"""
# text in figures is drawn by plotly, which knows nothing of the page's colours
_SCRIPT = """
const dark = matchMedia("(prefers-color-scheme: dark)");
function recolour() {
  for (const plot of document.querySelectorAll(".js-plotly-plot"))
    Plotly.relayout(plot, {
      "font.color": dark.matches ? "#c9d1da" : "#3a434e",
      "modebar.bgcolor": "rgba(0,0,0,0)",
      "modebar.color": "rgba(128,136,148,0.7)",
    });
}
recolour();
dark.addEventListener("change", recolour);
"""


@dataclass(frozen=True, eq=False)
class PageContent:
    """What a report shows; text is plain, the page escapes it.

    Attributes:
        title, subtitle: the head. metrics: name, value with unit, one sentence that explains it.
        scenes: caption and 3D figure of each. precision_recall: the curve's figure.
        training: the training's figure, or None. settings: YAML. provenance: name and value.
    """

    title: str
    subtitle: str
    metrics: Sequence[Row]
    scenes: Sequence[tuple[str, go.Figure]]
    precision_recall: go.Figure
    training: go.Figure | None
    settings: str
    provenance: Sequence[tuple[str, str]]


def write_page(path: Path, content: PageContent) -> None:
    """Write the report; the file appears when it is whole.

    Args:
        path: an HTML file; its folder must exist.
    """
    write_atomically(path, page_html(content).encode())


def page_html(content: PageContent) -> str:
    """The whole page."""
    figures = Figures()
    body = "\n".join(
        (
            _head(content),
            _cards(content.metrics),
            _scenes(content.scenes, figures),
            _curves(content, figures),
            _details(content),
        )
    )
    return document(content.title, body, figures)


def document(title: str, body: str, figures: "Figures", style: str = "") -> str:
    """A page in pnet's looks; it carries plotly.js once and loads nothing.

    Args:
        title: plain text. body: HTML in which every figure has its place. style: CSS of the page's own.
    """
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{escape(title)}</title>
<style>{_STYLE}{style}</style>
<script>{get_plotlyjs()}</script>
</head>
<body>
<main>
{body}
</main>
<script>
{figures.script()}
{_SCRIPT}</script>
</body>
</html>
"""


class Figures:
    """Gives every figure its place on the page and draws them all at the end."""

    def __init__(self) -> None:
        self._calls: list[str] = []

    def place(self, figure: go.Figure) -> str:
        """The element that the figure will fill."""
        name = f"figure-{len(self._calls)}"
        # plotly escapes <, > and /, so that nothing in a figure's text ends the script
        data = plotly.io.to_json(figure, validate=False)
        self._calls.append(f'draw("{name}", {data});')
        return f'<div class="plot" id="{name}"></div>'

    def script(self) -> str:
        """Code that draws the figures."""
        return "\n".join((f"const config = {json.dumps(_CONFIG)};{_DRAW}", *self._calls))


def _head(content: PageContent) -> str:
    return (
        f'<header><h1>{escape(content.title)}</h1>\n<p class="quiet">{escape(content.subtitle)}</p></header>'
    )


def _cards(metrics: Sequence[Row]) -> str:
    cards = [
        f'<div class="card"><h3>{escape(name)}</h3><strong>{escape(value)}</strong>'
        f"<p>{escape(explanation)}</p></div>"
        for name, value, explanation in metrics
    ]
    return "\n".join(('<section class="cards">', *cards, "</section>"))


def _scenes(scenes: Sequence[tuple[str, go.Figure]], figures: Figures) -> str:
    if not scenes:
        return ""
    shown = [
        f'<figure class="scene"><figcaption>{escape(caption)}</figcaption>{figures.place(figure)}</figure>'
        for caption, figure in scenes
    ]
    intro = (
        "<h2>Scenes</h2>\n"
        "<p class=\"quiet\">Seen from the camera's side, in the camera's frame. Drag to turn, scroll to "
        "zoom, point at a body for its score, dimensions and place. Points and estimates of one "
        "detection have one colour; grey points belong to none. Click a name above the "
        "scene to show or hide it; truth is hidden at first.</p>"
    )
    return "\n".join((intro, *shown))


def _curves(content: PageContent, figures: Figures) -> str:
    shown = [figure for figure in (content.precision_recall, content.training) if figure is not None]
    placed = [f"<figure>{figures.place(figure)}</figure>" for figure in shown]
    intro = (
        "<h2>Curves</h2>\n"
        '<p class="quiet">Precision is the share of the results that are right, recall the share of the '
        "bodies that are found; a lower score threshold moves along the curve to the right."
    )
    if content.training is not None:
        intro += " Losses of the network's modules are drawn over the training steps, lower is better."
    return "\n".join((f"{intro}</p>", '<section class="curves">', *placed, "</section>"))


def _details(content: PageContent) -> str:
    rows = [f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in content.provenance]
    parts = ["<h2>How it was made</h2>"]
    if rows:
        parts += ["<details open><summary>Provenance</summary><table>", *rows, "</table></details>"]
    if content.settings:
        parts.append(f"<details><summary>Settings</summary><pre>{escape(content.settings)}</pre></details>")
    return "\n".join(parts) if len(parts) > 1 else ""
