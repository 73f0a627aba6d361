import html
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import torch

from glassplat.evaluate import report
from glassplat.evaluate.evaluate import evaluate
from glassplat.evaluate.metrics import (
    FACTS,
    METRICS,
    PLANE_COLUMNS,
    SURFACE_FACTS,
    SURFACE_METRICS,
    format_value,
)
from glassplat.evaluate.report import (
    BACKGROUND,
    CAPTION_HEIGHT,
    MARGIN,
    TITLE_HEIGHT,
    Panel,
    Report,
    comparison_sheet,
    compose_sheet,
    overview_page,
    sheet_names,
)
from glassplat.evaluate.truth import TrueSurface
from glassplat.files.images import read_image
from glassplat.options import Blend
from glassplat.render.frame import Frame
from glassplat.render.layers import depth_colors, heat_colors, label_colors, layer_image, normal_colors
from glassplat.render.planar import dereflected_photo
from glassplat.scene.panes import Planes


class References(HTMLParser):
    """Collects the references of a page, and checks that its tags are balanced."""

    def __init__(self) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.links |= {value for name, value in attributes if name in ("src", "href") and value}
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def references(page: str) -> set[str]:
    parser = References()
    parser.feed(page)
    assert parser.open == []
    return parser.links


def written_report(case, folder: Path, blend: Blend | None = "linear") -> str:
    report = Report(folder, case.dataset, blend)
    evaluation = evaluate(case.scene, case.renderer, case.dataset, listen=report.add)
    results = {"method": "planar <&>", "iterations": 30, **evaluation.results}
    report.finish(results, evaluation.per_view)
    return (folder / "index.html").read_text(encoding="utf-8")


def test_every_view_has_a_sheet_and_the_page_shows_it(case, tmp_path: Path) -> None:
    page = written_report(case, tmp_path / "run")
    sheets = {"sheets/a.png", "sheets/b.png", "sheets/c.png"}
    assert references(page) == sheets | {"uses.png", "#a.jpg", "#b.jpg", "#c.jpg"}
    pictures = {str(path.relative_to(tmp_path / "run")) for path in (tmp_path / "run").rglob("*.png")}
    assert pictures == sheets | {"uses.png"}
    assert "planar &lt;&amp;&gt;" in page
    assert "http" not in page


def test_every_view_is_rendered_once_and_the_first_once_more_to_warm_up(case, tmp_path: Path) -> None:
    written_report(case, tmp_path / "run")
    assert case.renderer.calls == [40.0, 40.0, 41.0, 42.0]


def test_the_uses_are_shown_of_the_views_with_the_largest_panes(case, tmp_path: Path) -> None:
    written_report(case, tmp_path / "run")
    uses = read_image(tmp_path / "run" / "uses.png")
    row = CAPTION_HEIGHT + 32 * 6
    assert uses.shape == (2 * MARGIN + TITLE_HEIGHT + 2 * row + 10, 2 * MARGIN + 3 * 48 * 6 + 20, 3)
    top = MARGIN + TITLE_HEIGHT + CAPTION_HEIGHT
    first = uses[top : top + 32 * 6 : 6, MARGIN : MARGIN + 48 * 6 : 6]
    np.testing.assert_array_equal(first, case.dataset.test[0].photo.numpy())
    beside = MARGIN + 48 * 6 + 10
    dereflected = uses[top : top + 32 * 6 : 6, beside : beside + 48 * 6 : 6]
    expected = dereflected_photo(case.renderer.frames[40.0], case.dataset.test[0].photo, "linear")
    np.testing.assert_array_equal(dereflected, expected.numpy())


def test_captions_of_uses_have_no_dashes_that_the_font_joins(
    case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captions: list[str] = []
    monkeypatch.setattr(report, "Panel", lambda caption, image: captions.append(caption) or Panel(caption, image))
    written_report(case, tmp_path / "run")
    assert "pane as a mirror (glassplat render)" in captions and not any("--" in caption for caption in captions)


def test_uses_are_omitted_without_a_visible_pane(case, tmp_path: Path) -> None:
    unseen = replace(case, renderer=case.renderer.with_layers(strength=torch.zeros(32, 48)))
    assert "uses.png" not in references(written_report(unseen, tmp_path / "run"))
    assert not (tmp_path / "run" / "uses.png").exists()


def test_panels_are_below_their_captions(case) -> None:
    frame, view = case.renderer.frames[40.0], case.dataset.test[0]
    sheet = comparison_sheet(frame, view.photo, None, title="a")
    top, factor = MARGIN + TITLE_HEIGHT + CAPTION_HEIGHT, 6
    photo = sheet[top : top + 32 * factor, MARGIN : MARGIN + 48 * factor]
    np.testing.assert_array_equal(photo[::factor, ::factor], view.photo.numpy())


def test_a_name_with_a_line_break_is_drawn_on_one_line(case) -> None:
    frame, view = case.renderer.frames[40.0], case.dataset.test[0]
    broken, whole = (comparison_sheet(frame, view.photo, None, title=title) for title in ("a\nb.jpg", "a b.jpg"))
    np.testing.assert_array_equal(broken, whole)
    broken, whole = (compose_sheet([[Panel(text, view.photo)]], "", "") for text in ("a\r\nb.jpg", "a b.jpg"))
    np.testing.assert_array_equal(broken, whole)


def test_each_row_keeps_the_shape_of_its_pictures() -> None:
    """A portrait and a landscape image: 300 x 400 pixels, then 400 x 300."""
    rows = [[Panel("a", torch.full((300, 400, 3), 0.5))], [Panel("b", torch.full((400, 300, 3), 0.9))]]
    sheet = compose_sheet(rows, "", "")
    assert sheet.shape[:2] == (2 * MARGIN + TITLE_HEIGHT + 2 * CAPTION_HEIGHT + 300 + 400 + 10, 2 * MARGIN + 400)
    bright = (sheet == 230).all(axis=2)  # 0.9 of 255.
    assert int(bright.any(axis=1).sum()) == 400 and int(bright.any(axis=0).sum()) == 300


def test_rows_follow_what_is_known(case) -> None:
    full, view = case.renderer.frames[40.0], case.dataset.test[0]
    bare = replace(full, layers={})
    heights = [comparison_sheet(frame, view.photo, None, title="a").shape[0] for frame in (bare, full)]
    widths = [comparison_sheet(frame, view.photo, None, title="a").shape[1] for frame in (bare, full)]
    row = CAPTION_HEIGHT + 32 * 6 + 10
    assert heights[1] - heights[0] == row
    assert widths[1] - widths[0] == 48 * 6 + 10


def panel_at(sheet: np.ndarray, row: int, column: int) -> np.ndarray:
    """The pixels of one panel of a sheet of 48x32 images, which is drawn at six times that size."""
    top = MARGIN + TITLE_HEIGHT + CAPTION_HEIGHT + row * (CAPTION_HEIGHT + 32 * 6 + 10)
    left = MARGIN + column * (48 * 6 + 10)
    return sheet[top : top + 32 * 6 : 6, left : left + 48 * 6 : 6]


def test_true_normals_and_strength_stand_below_what_was_rendered(case) -> None:
    size, view = (32, 48), case.dataset.test[0]
    normal = torch.tensor([0.0, 0.0, 0.6]).expand(*size, 3)
    layers = {"base": torch.full((*size, 3), 0.25), "strength": torch.full(size, 0.4), "normal": normal}
    layers |= {"environment": torch.full((*size, 3), 0.75)}
    surface = TrueSurface(torch.ones(size, dtype=torch.bool), normal / 0.6, torch.full(size, 0.8))
    frame = replace(case.renderer.frames[40.0], layers=layers)
    sheet = comparison_sheet(frame, view.photo, None, surface=surface, title="a")
    second = [panel_at(sheet, 1, column)[0, 0].tolist() for column in range(4)]
    third = [panel_at(sheet, 2, column)[0, 0].tolist() for column in range(4)]
    assert second == [[64] * 3, [191] * 3, [128] * 3, [128, 128, 204]]
    assert third == [list(BACKGROUND), list(BACKGROUND), [255] * 3, [128, 128, 255]]
    without_layers = comparison_sheet(replace(frame, layers={}), view.photo, None, surface=surface, title="a")
    assert panel_at(without_layers, 1, 1)[0, 0].tolist() == [128, 128, 255]


def test_pixels_without_a_normal_are_grey() -> None:
    normals = torch.tensor([[0.0, 0.0, 0.0], [float("nan"), 0.0, 1.0], [-2.0, 1.0, 0.0]])
    assert normal_colors(normals).tolist() == [[0.5, 0.5, 0.5], [0.5, 0.5, 1.0], [0.0, 1.0, 0.5]]


def test_surface_metrics_are_shown_where_they_are_known() -> None:
    unknown = {"psnr": 30.0, "normal_error_deg": None, "normal_error_deg_reason": "the method renders no normals"}
    known = {"psnr": 30.0, "normal_error_deg": 4.871, "environment_gain": 1.5}
    assert "normal error" not in overview_page(unknown, {"a.jpg": unknown}, {})
    page = overview_page(known, {"a.jpg": known}, {})
    assert "<b>4.87°</b><span>normal error</span>" in page
    assert "<b>1.50</b><span>environment gain</span>" in page
    assert "<th>normal error</th>" in page and "<td>4.87°</td>" in page


def test_large_photographs_give_sheets_of_a_bearable_size(case) -> None:
    frame = replace(case.renderer.frames[40.0], rgb=torch.zeros(1920, 1080, 3), layers={})
    sheet = comparison_sheet(frame, torch.zeros(1920, 1080, 3, dtype=torch.uint8), None, title="a")
    assert sheet.shape[1] == 2 * MARGIN + 3 * 640 + 20


def test_a_method_without_layers_is_reported_too(case, tmp_path: Path) -> None:
    plain = replace(case, renderer=case.renderer.without_layers(), scene=replace(case.scene, planes=Planes.empty()))
    assert "PSNR, transmission" in written_report(plain, tmp_path / "run", blend=None)
    assert read_image(tmp_path / "run" / "sheets" / "a.png").shape[2] == 3


def test_missing_values_are_dashes_with_their_reason() -> None:
    page = overview_page({"lpips": None, "lpips_reason": 'no "weights"'}, {}, {})
    assert '<div title="no &quot;weights&quot;"><b>-</b><span>LPIPS</span></div>' in page


def test_the_page_explains_missing_numbers_and_metrics() -> None:
    reason = "no weights in <folder>"
    results = {"psnr": 30.0, "lpips": None, "lpips_reason": reason, "reflection_gain": 1.25, "planes": [{"label": 1}]}
    page = overview_page(results, {}, {})
    assert "Not measured: <b>LPIPS</b>: no weights in &lt;folder&gt;" in page
    for name in ("psnr", "reflection_gain"):
        metric = METRICS.get(name) or FACTS[name]
        assert f"<dt>{metric.label}</dt><dd>{html.escape(metric.meaning)}</dd>" in page
    assert "<dt>offset error, of the extent</dt><dd>distance of the true pane" in page
    assert "<dt>normal error, reflective</dt>" not in page
    assert "of the extent" not in overview_page(results | {"planes": []}, {}, {})
    assert "Not measured" not in overview_page({"psnr": 30.0}, {}, {})
    partial = overview_page({"psnr": 30.0, "pane_psnr": 25.0, "pane_psnr_views": 3, "num_test_views": 7}, {}, {})
    assert "Means over 3 of 7 views: <b>PSNR, pane</b>" in partial


def test_every_metric_is_written_with_its_unit_and_explained() -> None:
    columns = METRICS | SURFACE_METRICS | FACTS | SURFACE_FACTS | PLANE_COLUMNS
    assert all(column.label and len(column.meaning) > 10 for column in columns.values())
    units = {"psnr": " dB", "seconds": " s", "frame": " s", "deg": "°", "offset_error": "%"}
    for name, column in columns.items():
        unit = next((unit for end, unit in units.items() if name.endswith(end)), "")
        assert format_value(1, column.pattern).endswith(unit), name
        assert format_value(None, column.pattern) == "-"


@pytest.mark.parametrize("name", ["IMG#1.jpg", "what?.jpg", "50%25.jpg", "a & b.jpg", "Bild ä.jpg", "a\nb.jpg"])
def test_the_page_finds_sheets_of_any_name(name: str) -> None:
    sheets = sheet_names([name])
    found = references(overview_page({}, {name: {"psnr": 30.0}}, sheets))
    paths = {address for address in found if not address.startswith("#")}
    assert {unquote(address) for address in paths} == set(sheets.values())
    parsed = [urlsplit(address) for address in paths]
    assert [(part.query, part.fragment) for part in parsed] == [("", "")]
    assert found - paths == {f"#{name}"}


def test_names_of_sheets_are_distinct() -> None:
    assert sheet_names(["left/1.jpg", "2.png"]) == {"left/1.jpg": "sheets/left_1.png", "2.png": "sheets/2.png"}
    assert len(set(sheet_names(["1.jpg", "1.png"]).values())) == 2


def test_heat_gets_lighter_all_the_way() -> None:
    lightness = heat_colors(torch.linspace(0, 1, 50)) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (lightness.diff() > 0).all()
    assert (
        heat_colors(torch.tensor([-1.0, float("nan"), 7.0])).tolist() == heat_colors(torch.tensor([0.0, 0, 1])).tolist()
    )


def test_near_is_bright_and_nothing_is_black() -> None:
    depth = torch.tensor([[1.0, 2.0, 4.0, 0.0, 3.0, float("inf")]])
    alpha = torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.1, 1.0]])
    brightness = depth_colors(depth, alpha).sum(-1)[0]
    assert brightness[0] > brightness[1] > brightness[2] > 0
    assert brightness[3:].tolist() == [0, 0, 0]


def test_depth_of_one_distance_or_of_nothing() -> None:
    assert torch.isfinite(depth_colors(torch.full((3, 4), 2.0))).all()
    assert depth_colors(torch.zeros(3, 4), torch.ones(3, 4)).abs().max() == 0


def test_reflections_end_where_the_panes_do() -> None:
    reflection, mask = torch.rand(2, 3, 3), torch.tensor([[0.0, 0.5, 1.0], [0.0, 1.0, 0.0]])
    shown = layer_image(Frame(torch.rand(2, 3, 3), {"reflection": reflection, "mask": mask}), "reflection")
    assert torch.equal(shown, reflection * mask[..., None])
    assert torch.equal(layer_image(Frame(reflection, {"reflection": reflection}), "reflection"), reflection)


def test_labels_have_colours_of_their_own() -> None:
    colors = label_colors(torch.tensor([0, 1, 2, 3], dtype=torch.uint8))
    assert colors[0].tolist() == [0, 0, 0]
    assert len({tuple(color) for color in colors.tolist()}) == 4
