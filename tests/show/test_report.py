"""The report page: what is in it, and how it behaves in a real browser."""

import base64
import gzip
import json
import re
import tomllib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from finished import MAXIMUM, MINIMUM, no_bands, random_bands, without_intervals, write_run, write_surface
from helpers import invoke, wait_until
from PIL import Image

from sat_intervals.kernels.confidence import low_confidence
from sat_intervals.products import INVALID
from sat_intervals.raster import read_layers
from sat_intervals.results import open_results
from sat_intervals.show.legend import classify
from sat_intervals.show.report import contents
from sat_intervals.show.report.page import write_report

ROOT = Path(__file__).parents[2]
HOME, ARROW_RIGHT = "\ue011", "\ue014"  # keys by the standard WebDriver


def contents_of(path):
    """What the script of a page reads."""
    return json.loads(re.search(r'id="contents">(.*)</script>', path.read_text(encoding="utf-8"))[1])


def values_of(page, name):
    """A layer of a page, decoded as its script does."""
    layer = page["pixels"]["layers"][name]
    codes = np.frombuffer(gzip.decompress(base64.b64decode(layer["codes"])), f"<u{layer['bits'] // 8}")
    values = np.where(codes == 2 ** layer["bits"] - 1, np.nan, layer["first"] + layer["step"] * codes)
    return values.reshape(page["pixels"]["rows"], page["pixels"]["columns"])


def reported(folder, bands, validity, truth=None):
    """The page of a run made up of bands, and its contents."""
    path = write_report(open_results(write_run(folder, bands, validity, truth)))
    return path, contents_of(path)


def test_report__names_the_file_it_wrote(tmp_path):
    out = write_run(tmp_path, *random_bands(40, 50))
    done = invoke("report", out)
    assert done.exit_code == 0, done.output
    assert done.output.split() == [str(out / "report.html")]


def test_write_report__counts_every_pixel(tmp_path):
    bands, validity, _ = random_bands(700, 60)
    histograms = reported(tmp_path, bands, validity)[1]["histograms"]
    width = bands[2] - bands[1]
    low = low_confidence(bands[3], 0.6, 5)
    valid = classify(validity) < 2
    edges = np.arange(len(histograms["width"]["bars"]["low"]) + 1) * histograms["width"]["step"]
    for name, chosen in (("low", valid & low), ("high", valid & ~low)):
        np.testing.assert_array_equal(histograms["width"]["bars"][name], np.histogram(width[chosen], edges)[0])
    assert edges[-1] >= MAXIMUM - MINIMUM
    confidences = histograms["confidence"]["bars"]
    for name, chosen in (("valid", valid), ("rejected", ~valid)):
        assert sum(confidences[name]) == chosen.sum()
        assert confidences[name][-1] == (bands[3][chosen] >= np.float32(0.96)).sum()


def test_write_report__holds_rows_and_columns_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "_PIXELS", 5000)
    bands, validity, truth = random_bands(530, 70)
    page = reported(tmp_path, bands, validity, truth)[1]
    assert page["pixels"]["step"] == 3
    valid = classify(validity) < 2
    for name, band in zip(("disparity", "lower", "upper"), bands, strict=False):
        np.testing.assert_allclose(values_of(page, name), np.where(valid, band, np.nan)[::3, ::3], atol=1 / 64)
    for name, band in (("lower", bands[1]), ("upper", bands[2])):  # whole pixels, exactly
        np.testing.assert_array_equal(values_of(page, name), np.where(valid, band, np.nan)[::3, ::3])
    np.testing.assert_allclose(values_of(page, "truth"), truth[::3, ::3], atol=1 / 64)
    np.testing.assert_allclose(values_of(page, "confidence"), bands[3][::3, ::3], atol=1 / 250)
    np.testing.assert_array_equal(values_of(page, "kind"), classify(validity)[::3, ::3])
    missed = np.where(truth > bands[2], 1, np.where(truth < bands[1], 2, 0))
    np.testing.assert_array_equal(values_of(page, "missed"), np.where(valid, missed, 0)[::3, ::3])
    judged = valid & np.isfinite(truth)
    assert page["evaluation"]["all"]["count"] == judged.sum()
    assert page["evaluation"]["all"]["accuracy"] == pytest.approx((missed[judged] == 0).mean())


def test_write_report__of_a_large_image_stays_small(tmp_path):
    path, page = reported(tmp_path, *random_bands(720, 720))  # noise is as large as it gets
    assert page["pixels"]["rows"] * page["pixels"]["columns"] <= 500_000
    assert path.stat().st_size < 5_000_000


def test_write_report__loads_nothing(tmp_path):
    text = reported(tmp_path, *random_bands(40, 50))[0].read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.findall(r"<link|<img|\bsrc=|@import|url\(|\bfetch\(|XMLHttpRequest|\bimport\b", text)
    assert set(re.findall(r"https?://[^\"']*", text)) == {"http://www.w3.org/2000/svg"}  # the name of SVG


def test_write_report__takes_names_as_text(tmp_path):
    folder = tmp_path / "<script>alert(1)<" / "b>&amp;"
    folder.mkdir(parents=True)
    path, page = reported(folder, *random_bands(4, 5))
    assert page["run"]["inputs"]["left"]["path"] == str(folder / "left.tif")
    assert "<script>alert" not in path.read_text(encoding="utf-8")


def test_package_data__holds_the_parts_of_the_page():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["sat_intervals.show.report"]
    folder = ROOT / "sat_intervals" / "show" / "report"
    shipped = {file for pattern in patterns for file in folder.glob(pattern)}
    assert shipped == {file for file in folder.iterdir() if file.is_file() and file.suffix != ".py"}


def test_write_report__shows_the_main_figures_without_scripts(tmp_path):
    bands, validity, truth = random_bands(60, 80)
    path, page = reported(tmp_path, bands, validity, truth)
    static = re.search(r"<noscript>\n(.*)</noscript>", path.read_text(encoding="utf-8"), re.DOTALL)[1]
    assert f"<td>{100 * page['evaluation']['all']['accuracy']:.1f} % of the valid pixels with a truth</td>" in static
    shares = re.findall(r"<td>(\d+\.\d) % of the pixels</td>", static)
    assert sum(map(float, shares)) == pytest.approx(100, abs=0.4)
    assert page["classes"] == np.bincount(classify(validity).ravel()).tolist()


def test_write_report__shows_hillshade_half_widths_and_completeness_of_a_surface(tmp_path):
    bands, validity, truth = random_bands(60, 80)
    out = write_run(tmp_path, bands, validity, truth)
    height = np.add.outer(np.arange(40.0), np.arange(50.0) ** 2 / 9)
    height[:, :10] = np.nan
    write_surface(out, height)
    path = write_report(open_results(out))
    surface = contents_of(path)["surface"]
    assert surface["figures"]["completeness, cells with a height"] == "80.0 %"
    assert "<td>80.0 %</td>" in path.read_text(encoding="utf-8")
    shade, half = (np.array(Image.open(BytesIO(base64.b64decode(one["png"])))) for one in surface["maps"])
    assert (shade.shape, half.shape) == ((40, 50, 2), (40, 50, 4))
    np.testing.assert_array_equal(half[..., -1], np.where(np.isfinite(height), 255, 0))
    assert not shade[:, :10, -1].any()
    assert len(np.unique(shade[:, 12:, 0])) > 10
    assert half[5, 20].tolist() == [252, 253, 191, 255]  # all as wide as the widest


@pytest.mark.peer("shareloc")
def test_write_report__of_many_images_is_in_metres(swept):
    path = write_report(open_results(swept))
    page, report = contents_of(path), json.loads((swept / "run.json").read_text())
    assert (page["quantity"]["name"], page["quantity"]["unit"], page["name"]) == ("height", "m", "3 images")
    bands, validity = read_layers(swept / "dsm.tif"), read_layers(swept / "validity.tif")[0]
    height = np.where(validity & INVALID == 0, bands[0], np.nan)
    np.testing.assert_allclose(values_of(page, "disparity"), height, atol=0.01)
    assert page["run"]["inputs"].keys() == {"image_1", "image_2", "image_3"}
    low, high = report["sweep"]["heights"]
    text = path.read_text(encoding="utf-8")
    assert f"<td>{low:.2f} to {high:.2f} m</td>" in text
    static = re.search(r"<noscript>\n(.*)</noscript>", text, re.DOTALL)[1]
    assert "fewer than two images see the cell" in static
    assert not re.search(r"px|[Dd]isparit", static)


# ---- In a browser ------------------------------------------------------------------------------------------
class Page:
    """A report, opened from the disk."""

    def __init__(self, browser, path):
        self.browser = browser
        browser.get(path.as_uri())
        wait_until(lambda: browser.execute_script("return 'ready' in document.documentElement.dataset"), "page")

    def find(self, selector):
        return self.browser.find_element("css selector", selector)

    def text(self, selector):
        return self.find(selector).text

    def band(self):
        """The interval's outline, read in one step: the page may draw it anew between two."""
        return self.browser.execute_script("return document.querySelector('#band').getAttribute('d')")

    def map(self):
        """The picture of the map as text."""
        return self.browser.execute_script("return document.querySelector('#map canvas').toDataURL()")

    def complaints(self):
        return self.browser.get_log("browser")


@pytest.fixture
def page(browser, tmp_path):
    """The page of 60 x 80 random pixels with truth."""
    path, _ = reported(tmp_path, *random_bands(60, 80))
    opened = Page(browser, path)
    yield opened
    assert opened.complaints() == []


def test_page__tells_what_the_run_tells(page):
    assert page.browser.title == "left.tif: disparity intervals"
    assert "60 rows by 80 columns, disparities \u221220 to 10 px" in page.text("#about")
    assert "intervals that contain the truth" in page.text("#headline")
    for selector, words in (
        ("#validity", "rejected by cross-checking: occlusion"),
        ("#search", "Disparities \u221220 to 10 px, given. Of the valid pixels, 0.0 % are within 1 px of the minimum"),
        ("#search", "5.0 % of its pixels are 0"),
        ("#warnings", "left.tif: 5 % of the pixels are exactly 0"),
        ("#tiles", "6 tiles of 27 x 27 pixels"),
        ("#evaluation", "high confidence"),
        ("#run", "keep_rejected"),
        ("#run", "tiles, read (sum over workers)"),
    ):
        assert words in page.text(selector)
    assert page.browser.execute_script("return document.querySelectorAll('svg[role=img][aria-label]').length") == 4
    assert not page.browser.find_elements("css selector", "#loading")
    assert not {"null", "walltime"} & set(page.text("#run").split())  # settings without a value


def test_page__click_on_the_map_shows_that_row(page):
    from selenium.webdriver import ActionChains

    before = page.band()
    assert before.count("M") > 3
    canvas = page.find("#map canvas")
    # from the middle of the map: up by a quarter of its rows, right by a quarter of its columns
    size = canvas.size
    ActionChains(page.browser).move_to_element_with_offset(
        canvas, size["width"] / 4, -size["height"] / 4
    ).click().perform()
    assert page.band() != before
    row, column = int(page.text("#row-number")), int(page.text("#column-number"))
    assert (row, column) == pytest.approx((15, 60), abs=1)
    assert f"Row {row}, column {column}: " in page.text("#pixel")
    assert page.text("#command").endswith(f"--row {row} --pixel {row} {column}")


def test_page__says_of_a_pixel_what_the_files_say(browser, tmp_path):
    bands, validity = no_bands(9, 11)
    bands[:, 4, 5], validity[4, 5] = (-3.25, -4, -2, 0.5), 0
    path, _ = reported(tmp_path, bands, validity, np.full((9, 11), -3.5))
    words = Page(browser, path).text("#pixel").replace("\u2212", "-")
    figures = "disparity -3.25 px, interval -4.0 to -2.0 px, confidence 0.50, truth -3.50 px"
    assert words == f"Row 4, column 5: valid, high confidence, {figures}"


def test_page__layers_change_the_map_and_its_key(page):
    seen = {}
    for label in page.browser.find_elements("css selector", "#layers label"):
        label.click()
        seen[label.text] = page.map(), page.text("#key")
    assert list(seen) == ["Left image", "Disparity", "Interval width", "Confidence", "Validity", "Misses"]
    assert len({shown for shown, _ in seen.values()}) == len({key for _, key in seen.values()}) == 6
    assert "px" in seen["Disparity"][1]
    assert "truth above the interval" in seen["Misses"][1]


def test_page__of_a_run_without_intervals_claims_none(browser, tmp_path):
    page = Page(browser, write_report(open_results(without_intervals(tmp_path))))
    line, box = page.browser.execute_script("""
        const chart = document.querySelector("#profile svg").getBoundingClientRect();
        const line = [...document.querySelectorAll("#profile path")].at(-1);
        return [line.getBoundingClientRect().toJSON(), chart.toJSON()];""")
    assert box["top"] <= line["top"] < line["bottom"] <= box["bottom"]
    assert "no valid pixel in this row" not in page.text("#profile")
    assert page.text("#profile-key").splitlines()[0].startswith("disparity")
    assert "band" not in page.text("#profile-key")
    layers = [label.text for label in page.browser.find_elements("css selector", "#layers label")]
    assert layers == ["Left image", "Disparity", "Confidence", "Validity"]
    bands = read_layers(tmp_path / "out" / "intervals.tif")
    disparity = np.where(read_layers(tmp_path / "out" / "validity.tif")[0] & INVALID == 0, bands[0], np.nan)
    column = int(np.flatnonzero(np.isfinite(disparity[20]))[0])
    for name, steps in (("row", 0), ("column", column)):
        page.find(f"#{name}").send_keys(HOME if name == "column" else "", *[ARROW_RIGHT] * steps)
    words = page.text("#pixel").replace("\u2212", "-")
    assert f"disparity {disparity[20, column]:.1f}"[:-1] in words
    assert "interval " not in words.replace("interval regularised", "")
    assert page.complaints() == []


def test_page__draws_the_offsets_of_the_rows(browser, tmp_path):
    out = write_run(tmp_path, *random_bands(60, 80))
    report = json.loads((out / "run.json").read_text())
    samples = [[10, 20, 1.25, -0.05], [40, 60, 1.5, 0.1]]
    report |= {
        "survey": {"rows": {"before": [1.4, 1.5], "after": [0.08, 0.1], "samples": samples}},
        "rows": {"coefficients": [1.4], "rows": 60, "columns": 80},
    }
    (out / "run.json").write_text(json.dumps(report))
    page = Page(browser, write_report(open_results(out)))
    words = page.text("#search").replace("\u2212", "-")
    assert "differ by 1.40 px in the median, 0.08 px after they were moved" in words
    assert {"1.25", "-0.05", "1.50", "0.10"} <= set(words.split())
    assert page.complaints() == []


@pytest.mark.parametrize("width", [500, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page__fits_the_window_and_reads_in_light_and_dark(page, width, scheme):
    page.browser.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    )
    page.browser.set_window_size(width, 1600)
    script = """
        const { color, backgroundColor } = getComputedStyle(document.body);
        return [document.documentElement.scrollWidth, window.innerWidth, color, backgroundColor];"""
    across, room, *colours = page.browser.execute_script(script)
    assert across <= room
    ink, paper = (sum(map(int, re.findall(r"\d+", colour))) for colour in colours)
    assert (ink < paper) == (scheme == "light")
    assert abs(ink - paper) > 500


@pytest.mark.peer("shareloc")
def test_page__of_many_images_shows_heights_and_shifts(browser, swept):
    page = Page(browser, write_report(open_results(swept)))
    assert page.browser.title == "3 images: height intervals"
    layers = [label.text for label in page.browser.find_elements("css selector", "#layers label")]
    assert (
        layers == ["Hillshade", "Height", "Interval width", "Confidence", "Validity", "Heights searched"][: len(layers)]
    )
    assert "Images and heights" in page.text("#search")
    for image in json.loads((swept / "run.json").read_text())["sweep"]["images"]:
        assert f"{image['shift'][1]:.2f}".replace("-", "\u2212") in page.text("#search")
    assert not re.search(r"\bpx\b|[Dd]isparit", page.text("body"))
    assert not page.find("#command").is_displayed()
    assert page.complaints() == []
