"""The numbers of three detectors, each with its source; a preset only fills what the user has not set."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

IDEAL: Mapping[str, Any] = MappingProxyType(
    {
        "quantum_efficiency": 1.0,
        "background_photons": 0.0,
        "dark_electrons": 0.0,
        "read_noise_electrons": 0.0,
        "em_gain": 1.0,
        "gain_electrons_per_adu": 1.0,
        "full_well_electrons": math.inf,
        "bits": 0,
        "bias_adu": 0.0,
    }
)
"""Every photon is counted: photon noise and nothing else."""

QCMOS: Mapping[str, Any] = MappingProxyType(
    {
        # Typical curve of the Hamamatsu C15550-22UP catalogue (SCAS0166E) at 0.65 um; 0.85 at its peak (0.46
        # um), 0.33 at 0.85 um.
        "quantum_efficiency": 0.55,
        "background_photons": 0.0,
        # 3.6e-3 e-/s measured on the ORCA-Quest cameras of Subaru's VAMPIRES (its documentation, "Cameras"),
        # in an exposure of 1/2000 s.
        "dark_electrons": 1.8e-6,
        # The same page: 0.40 e- in the fast mode (Hamamatsu: 0.43). The 0.27 e- of the catalogue (VAMPIRES:
        # 0.24) belong to the ultra-quiet mode, whose 172.8 us per four rows limit 128 rows to 180 Hz: no
        # sensor for a loop.
        "read_noise_electrons": 0.40,
        "em_gain": 1.0,
        "gain_electrons_per_adu": 0.103,  # the same page, fast mode
        "full_well_electrons": 7000.0,  # catalogue
        "bits": 16,  # catalogue
        "bias_adu": 200.0,  # digital offset, catalogue
    }
)
"""Hamamatsu ORCA-Quest in its fast mode, as used at 2 kHz."""

EMCCD: Mapping[str, Any] = MappingProxyType(
    {
        # CCD220 deep depletion at 0.65 um (Teledyne e2v data sheet, -40 C); 0.88 at 0.85 um.
        "quantum_efficiency": 0.94,
        "background_photons": 0.0,
        # Dark current and clock-induced charge together at 2067 Hz and -45 C (Keck AO Note 1337, S/N
        # 02-2019-051, as tabulated in getframes 2.6, `andor_ocam2k`).
        "dark_electrons": 5.7e-3,
        # At the output amplifier: 0.36 e- at the input times the gain of 600 (the same note).
        "read_noise_electrons": 216.0,
        "em_gain": 600.0,
        "gain_electrons_per_adu": 28.0,  # at the output amplifier, the same note
        "full_well_electrons": 270000.0,  # image area, Andor's data sheet
        "bits": 14,  # Andor's data sheet
        "bias_adu": 408.0,  # the same note
    }
)
"""Andor / First Light OCAM2K (e2v CCD220) at a multiplication of 600."""

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {"ideal": IDEAL, "qCMOS": QCMOS, "EMCCD": EMCCD, "custom": IDEAL}
)
"""What each preset fills; `custom` starts from the ideal detector and carries no name of a camera."""
