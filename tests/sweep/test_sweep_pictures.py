"""Figures of a sweep and the profiles of its images: numbers from rows and files that the test writes itself."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from nlcwfs.interop import Provenance
from nlcwfs.studies.image_profiles import PROFILES, keep_profiles, ring_means
from nlcwfs.studies.loop_figures import MAGNITUDE, draw_cases, draw_images, draw_magnitudes, draw_rates

STAMP = Provenance.collect({}, seed=None, device="test")


def row(case: str, rate: float, seed: int, rms: float, **more) -> dict:
    name = f"{case},loop.rate_hz={rate:g},seed={seed}"
    told = {"point": name, "case": case, "loop.rate_hz": rate, "seed": seed, "outcome": "closed", "error": ""}
    return told | {"rms_nm": rms, "strehl": 0.7, "floor_nm": 70.0, "frames_to_close": 4} | more


def image_file(folder, name: str, image: np.ndarray, step: float = 0.011) -> None:
    path = folder / "runs" / name / "psf.fits"
    path.parent.mkdir(parents=True)
    hdu = fits.PrimaryHDU(image.astype(np.float32))
    hdu.header["PIXSCALE"] = step
    hdu.writeto(path)


def test_rings_are_means_of_the_pixels_at_that_distance():
    image = np.random.default_rng(3).random((9, 9))
    rings: dict[int, list[float]] = {}
    for i in range(9):
        for j in range(9):
            rings.setdefault(round(np.hypot(i - 4, j - 4)), []).append(image[i, j])
    wanted = [np.mean(rings[number]) for number in range(5)]
    assert ring_means(image) == pytest.approx(wanted)


def test_profiles_outlive_the_images(tmp_path):
    rows = [row("a", 200, 0, 80.0), row("b", 200, 0, 90.0)]
    image = np.zeros((7, 7))
    image[3, 3], image[3, 4] = 1.0, 0.4
    image_file(tmp_path, rows[0]["point"], image)
    first = keep_profiles(tmp_path, rows, STAMP)
    assert first[rows[0]["point"]].tolist() == pytest.approx([1.0, 0.4 / 8, 0, 0])  # eight neighbours at 1 and root 2
    assert first["angle_arcsec"].tolist() == pytest.approx([0, 0.011, 0.022, 0.033])
    (tmp_path / "runs" / rows[0]["point"] / "psf.fits").unlink()
    image_file(tmp_path, rows[1]["point"], 2 * image)
    both = keep_profiles(tmp_path, rows, STAMP)
    assert list(both) == ["angle_arcsec", rows[0]["point"], rows[1]["point"]]
    assert np.allclose(2 * both[rows[0]["point"]], both[rows[1]["point"]])
    on_disk = Table.read(tmp_path / PROFILES, format="ascii.ecsv")
    assert np.allclose(on_disk[rows[1]["point"]], both[rows[1]["point"]])


def test_without_images_there_is_no_table(tmp_path):
    assert keep_profiles(tmp_path, [row("a", 200, 0, 80.0)], STAMP) == {}
    assert not (tmp_path / PROFILES).exists()


def test_an_unchanged_table_keeps_its_stamp(tmp_path):
    rows = [row("a", 200, 0, 80.0)]
    image_file(tmp_path, rows[0]["point"], np.eye(7))
    keep_profiles(tmp_path, rows, STAMP)
    before = (tmp_path / PROFILES).read_bytes()
    keep_profiles(tmp_path, rows, Provenance.collect({"other": 1}, seed=None, device="other"))
    assert (tmp_path / PROFILES).read_bytes() == before


def test_rates_are_medians_over_seeds_with_their_range(tmp_path):
    rows = [row("a", rate, seed, rate / 2 + seed) for rate in (300, 100, 200) for seed in (0, 1, 5)]
    rows += [row("few", 100, 0, 50.0), row("few", 200, 0, 50.0)]  # two rates are no curve
    rows += [row("a", 100, 9, 999.0, outcome="lost")]
    figure = draw_rates(tmp_path, rows)
    assert figure is not None
    (container,) = figure.axes[0].containers
    line = container.lines[0]
    assert line.get_xdata().tolist() == [100, 200, 300]
    assert line.get_ydata().tolist() == [51, 101, 151]
    (bars,) = container.lines[2]
    assert [tuple(np.round(bar[:, 1], 6)) for bar in bars.get_segments()] == [(50, 55), (100, 105), (150, 155)]
    assert draw_rates(tmp_path, rows[9:]) is None


@pytest.mark.parametrize("rate", ["", np.nan])
def test_a_sweep_that_varies_no_rate_has_no_curve_of_rates(tmp_path, rate):
    rows = [row("a", 0, seed, 80.0) | {"loop.rate_hz": rate} for seed in range(3)]
    assert draw_rates(tmp_path, rows) is None


def test_images_show_one_curve_a_case(tmp_path):
    rows = [row("a", 200, seed, 80.0) for seed in (0, 1)] + [row("b", 200, 0, 120.0)]
    assert draw_images(tmp_path, rows) is None
    for number, one in enumerate(rows):
        image_file(tmp_path, one["point"], np.full((7, 7), 0.1 * (number + 1)))
    keep_profiles(tmp_path, rows, STAMP)
    figure = draw_images(tmp_path, rows)
    assert figure is not None
    lines = figure.axes[0].get_lines()
    assert [line.get_ydata()[0] for line in lines] == pytest.approx([0.1, 0.3])
    assert lines[1].get_label() == "b: 120 nm, Strehl 0.70"


def test_a_star_is_shown_at_the_rate_that_keeps_most_loops_closed(tmp_path):
    rows = [
        row("a", rate, seed, rms, **{MAGNITUDE: 15.0}) for rate, rms in ((100, 150.0), (200, 130.0)) for seed in (0, 1)
    ]
    rows += [row("a", 400, 0, 90.0, **{MAGNITUDE: 15.0}), row("a", 400, 1, 90.0, outcome="lost", **{MAGNITUDE: 15.0})]
    rows += [row("a", 100, 0, 110.0, **{MAGNITUDE: 8.0}), row("dark", 100, 0, 1.0, outcome="lost", **{MAGNITUDE: 18.0})]
    figure = draw_magnitudes(tmp_path, rows)
    assert figure is not None
    (container,) = figure.axes[0].containers
    assert container.lines[0].get_xdata().tolist() == [8, 15]
    assert container.lines[0].get_ydata().tolist() == [110, 130]
    assert draw_magnitudes(tmp_path, rows[-1:]) is None
    assert draw_magnitudes(tmp_path, [row("a", 100, 0, 80.0)]) is None  # no magnitudes


def test_cases_show_every_loop_and_how_many_closed(tmp_path):
    rows = [row("a", 200, seed, 80.0 + seed) for seed in (0, 1)] + [row("a", 200, 2, 900.0, outcome="lost")]
    rows += [row("b", 200, 0, np.nan, outcome="not closed")]
    figure = draw_cases(tmp_path, rows)
    assert figure is not None
    closed, lost, floor = figure.axes[0].get_lines()
    assert closed.get_xdata().tolist() == [80, 81]
    assert lost.get_xdata().tolist() == [900]
    assert set(floor.get_xdata()) == {70}
    labels = [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    assert labels == ["a, 2 of 3 closed", "b, 0 of 1 closed"]
