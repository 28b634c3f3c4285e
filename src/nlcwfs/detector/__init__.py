"""Light becomes numbers.

Enters: photons on a grid finer and wider than the detector, `photon_rate[plane y x]`. Leaves: `Frames`, the
estimated photo-electrons of every pixel, `electrons[plane y x]`, and which pixels are `saturated`.

Equations, in the order of the light, for a pixel and an exposure:

- `photons` = sum of the photon rate over the area of the pixel (`pixels`);
- `mean = quantum_efficiency * (photons + background_photons) + dark_electrons`;
- `collected = min(Poisson(mean), full_well_electrons)` (`photon_noise`);
- `multiplied = Gamma(collected * G / (G - 1)) * (G - 1)`, G = `em_gain` (`electron_multiplication`);
- `adu = round(bias_adu + (multiplied + Normal(0, read_noise_electrons)) / gain_electrons_per_adu)`, kept
  within the codes of the converter (`converter`);
- `electrons = (adu - bias_adu) * gain_electrons_per_adu / G`: bias and multiplication are undone, background
  and dark are **not** subtracted, because their noise stays in the data and estimators need both.

An estimator may assume the variance `(2 - 1/G) mean + (read_noise^2 + gain^2 / 12) / G^2` of `electrons`.
"""

from nlcwfs.detector.converter import adu_to_electrons, at_full_scale, electrons_to_adu
from nlcwfs.detector.electron_multiplication import excess_noise_factor, multiply_electrons
from nlcwfs.detector.photon_noise import sample_poisson
from nlcwfs.detector.pixels import fraction_outside_window, integrate_on_pixels
from nlcwfs.detector.read import Detector, Frames
from nlcwfs.detector.settings import DetectorSettings
from nlcwfs.detector.sparse_photons import room_for_photons, sample_sparse_photons

__all__ = [
    "Detector",
    "DetectorSettings",
    "Frames",
    "adu_to_electrons",
    "at_full_scale",
    "electrons_to_adu",
    "excess_noise_factor",
    "fraction_outside_window",
    "integrate_on_pixels",
    "multiply_electrons",
    "room_for_photons",
    "sample_poisson",
    "sample_sparse_photons",
]
