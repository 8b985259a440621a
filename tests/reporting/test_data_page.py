"""Tables of a data set, and a page of its scenes."""

import json
import math
import re
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from pnet.reporting.data_page import (
    DataPage,
    data_page_html,
    sample_scenes,
    scene_caption,
    truth_figure,
    write_data_page,
)
from pnet.reporting.data_tables import (
    Sheet,
    bar,
    coverage_sheet,
    html_table,
    percent,
    pile_sheet,
    rich_table,
    settings_sheet,
    size_text,
    split_sheet,
    summary_sheets,
    summary_values,
    visibility_sheet,
)
from pnet.scenes.coverage import Coverage
from pnet.scenes.inspection import DataSet, PileSummary, SplitSummary, Summary
from pnet.scenes.protocol import Protocol, SplitPlan
from pnet.scenes.store import CycleHeader, write_cycle

TRAIN = SplitSummary(
    part_objects=2, planned=4, whole=2, missing=1, damaged=1, scenes=1234, instances=8, to_find=6,
    size=12_345_678, escaped=5, unsettled=6, empty=7, points=(512, 4096),
    visibility=[0, 1, 0, 0, 0, 0, 0, 0, 3, 4],
)  # fmt: skip
SUMMARY = Summary(
    {"train": TRAIN, "val": SplitSummary(planned=1, missing=1)},
    PileSummary(planned=5, whole=3, missing=2, size=999),
    {"pile": Coverage(6, 12, 0.423, 7 / 12), "clutter": Coverage(0, 12, math.nan, math.nan)},
)
SETTINGS = {
    "part": {"_target_": "pnet.parts.tn34.TN34", "learning": {"r": [12, 14]}, "sections": 48},
    "protocol": {"_target_": "pnet.scenes.protocol.Protocol", "name": "tiny", "splits": {"train": {}}},
    "noise": {"_target_": "pnet.scenes.noise.NoNoise"},
    "physics": {"_target_": "x.Physics", "rest_speed": 0.005},
    "seed": 0,
}


def rows(sheet: Sheet) -> dict[str, list[str]]:
    return {name: cells for name, *cells in sheet.rows}


def printed(sheet: Sheet) -> str:
    out = Console(width=120, file=StringIO())
    out.print(rich_table(sheet))
    return out.file.getvalue()


def test_splits_are_told_in_numbers():
    told = rows(split_sheet(SUMMARY.splits))
    assert told["part objects"] == ["2", "0"]
    assert [told[name][0] for name in ("cycles planned", "whole", "missing", "damaged")] == list("4211")
    assert told["scenes"] == ["1,234", "0"] and told["size"] == ["12.3 MB", "0 B"]
    assert told["at most half occluded"] == ["75.0%", "–"]
    assert told["points a scene"] == ["512 to 4,096", "–"]
    assert [told[name][0] for name in ("bodies escaped", "scenes unsettled", "scenes empty")] == list("567")


def test_visibility_is_drawn_in_bars_of_one_width():
    told = rows(visibility_sheet(SUMMARY.splits))
    assert list(told)[:2] == ["0.0 to 0.1", "0.1 to 0.2"] and len(told) == 10
    assert told["0.9 to 1.0"] == ["4 █████", "0      "]
    assert told["0.8 to 0.9"][0] == "3 ███▊ " and told["0.1 to 0.2"][0] == "1 █▎   "


@pytest.mark.parametrize(
    ("share", "drawn"), [(0, "     "), (1e-9, "▏    "), (0.1, "▌    "), (0.2, "█    "), (1, "█████")]
)
def test_a_bar_has_eighths(share, drawn):
    assert bar(share) == drawn


def test_coverage_and_piles_are_told():
    assert rows(coverage_sheet(SUMMARY.coverage)) == {
        "pile": ["6", "12", "42.3%", "58.3%"],
        "clutter": ["0", "12", "–", "–"],
    }
    assert rows(pile_sheet(SUMMARY.piles)) == {"cycles": ["5", "3", "2", "0", "999 B"]}


def test_settings_are_told_by_class_and_values():
    assert rows(settings_sheet(SETTINGS)) == {
        "part": ["TN34: learning r [12, 14], sections 48"],
        "protocol": ["Protocol: name tiny"],
        "physics": ["Physics: rest_speed 0.005"],
        "noise": ["NoNoise"],
        "seed": ["0"],
    }


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (99_940, "99.9 kB"), (123_456, "123 kB"),
     (999_600, "1.0 MB"), (2 * 10**9, "2.0 GB"), (5 * 10**15, "5000 TB")],
)  # fmt: skip
def test_sizes_are_for_people(size, text):
    assert size_text(size) == text


def test_a_share_of_nothing_is_a_dash():
    assert percent(0, 0) == "–" and percent(1, 8) == "12.5%"


def test_tables_print_what_they_hold_even_brackets():
    text = printed(Sheet("Title", ("", "[b]"), [("[red]", "1"), ("two", "22")], "a note"))
    lines = [line.rstrip() for line in text.splitlines()]
    assert "Title" in lines[0] and "[b]" in text and "a note" in lines[-1]
    assert "│ [red] │   1 │" in text and "│ two   │  22 │" in text
    assert "│ 4 █████ │" in printed(visibility_sheet(SUMMARY.splits))


def test_tables_of_a_page_are_escaped():
    text = html_table(Sheet("<i>", ("&", "<b>"), [("<a>", "<c>")], "<note>"))
    assert not re.search(r"<[iabc]>|<note>", text)
    assert "&lt;a&gt;" in text and "&lt;note&gt;" in text


def test_the_numbers_are_plain_values():
    values = json.loads(json.dumps(summary_values(SETTINGS, SUMMARY)))
    assert values["splits"]["train"]["size"] == 12_345_678
    assert values["splits"]["train"]["points"] == [512, 4096]
    assert values["coverage"]["pile"] == {"instances": 6, "cells": 12, "share": 0.423, "rare": 7 / 12}
    assert values["piles"]["missing"] == 2 and values["settings"] == SETTINGS


@pytest.fixture(scope="module")
def data(tn34, make_scene, tmp_path_factory) -> DataSet:
    """Three part objects with two cycles of piles and two of clutter each, one of them to test; three scenes
    a cycle, the first object's first cycle without any."""
    root = tmp_path_factory.mktemp("samples")
    splits = {
        "train": SplitPlan("L", cycles=2, objects=[0, 5, 15], clutter=0.5),
        "test_l": SplitPlan("L", cycles=1, first_cycle=9, objects=[0]),
    }
    protocol = Protocol("hand", drop_limit=3, points=256, splits=splits)
    tasks = protocol.tasks({"L": list(range(16))})
    data = DataSet(root, root / "piles", tn34, protocol, tasks, "tiny", "tiny", {"train": 12, "test_l": 1})
    for task in tasks:
        data.scene_path(task).parent.mkdir(exist_ok=True)
        empty = task.split == "train" and task.kind == "pile" and (task.cycle, task.part_index) == (0, 0)
        drops = () if empty else (1, 2, 3)
        scenes = [replace(make_scene(tn34, d, 256, task.part_index), id=task.scene_id(d)) for d in drops]
        camera = make_scene(tn34).camera
        header = CycleHeader(
            "tiny", "tn34", camera, task.split, task.kind, task.cycle, task.part_index, drops
        )
        write_cycle(data.scene_path(task), header, scenes)
    return data


def test_samples_are_full_bins_spread_over_splits_kinds_and_part_objects(data):
    chosen = [scene.id for scene in sample_scenes(data, data.splits, 5)]
    assert [(i.split, i.kind) for i in chosen] == [
        *[("train", "pile")] * 2, *[("train", "clutter")] * 2, ("test_l", "pile"),
    ]  # fmt: skip
    assert {i.drop for i in chosen} == {3}
    assert {i.part_index for i in chosen} == {0, 5, 15}
    assert len({str(i) for i in chosen}) == 5


def test_samples_are_of_the_split_and_no_more_than_there_are(data):
    assert [str(s.id) for s in sample_scenes(data, ["test_l"], 6)] == ["test_l/pile_0009_part_00/003"]
    every = [scene.id for scene in sample_scenes(data, ["train"], 100)]
    assert len(every) == 11 and {i.split for i in every} == {"train"}


def test_samples_leave_out_what_is_damaged(data):
    assert sample_scenes(replace(data, fingerprint="other"), ["train"], 3) == []


def test_a_figure_shows_every_body(data):
    (scene,) = sample_scenes(data, ["test_l"], 1)
    figure = truth_figure(scene, data.part)
    layers = {trace.name: trace for trace in figure.data}
    points = layers["points"]
    assert len(points.x) == 256 and len(set(points.marker.color)) == 3
    assert points.hovertemplate.startswith("<b>body ") and "visibility" in points.hovertemplate
    assert np.asarray(points.customdata)[0, 1] == pytest.approx(scene.visibility[scene.instance[0]], rel=1e-6)
    assert layers["bodies"].visible is None and len(layers["bodies"].x) > 0
    assert "estimates" not in layers and "truth" not in layers


def test_a_caption_says_where_it_is_from_and_what_it_holds(data):
    (scene,) = sample_scenes(data, ["test_l"], 1)
    occluded = replace(scene, occlusion=np.array([0.2, 0.5, 0.6]))
    assert scene_caption(occluded, data.part) == (
        "test_l/pile_0009_part_00/003: 3 bodies, 2 at most half occluded; r = 12 mm, h = 10 mm"
    )


def test_the_page_holds_tables_and_figures_and_loads_nothing(data, tmp_path):
    scenes = sample_scenes(data, ["train"], 2)
    content = DataPage(
        "pnet: <data>",
        "sub & title",
        summary_sheets(SETTINGS, SUMMARY),
        [(scene_caption(scene, data.part), truth_figure(scene, data.part)) for scene in scenes],
    )
    write_data_page(tmp_path / "page.html", content)
    text = (tmp_path / "page.html").read_text()
    assert text == data_page_html(content)
    for title in ("Settings", "Splits", "Instances by visibility", "Orientations", "Piles", "Sample scenes"):
        assert f"<h2>{title}</h2>" in text
    assert "pnet: &lt;data&gt;" in text and "sub &amp; title" in text and "<data>" not in text
    assert text.count('class="plot"') == 2 and text.count('draw("figure-') == 2
    assert text.count("<table") == 5 and "Content-Security-Policy" in text and 'src="http' not in text
