"""What users may rely on changes only on purpose."""

import difflib

from public_names import SNAPSHOT, reference_modules, snapshot


def test_the_public_names_are_those_of_the_snapshot():
    kept, now = SNAPSHOT.read_text("utf-8").splitlines(), snapshot().splitlines()
    changes = "\n".join(difflib.unified_diff(kept, now, "snapshot", "sources", lineterm="", n=1))
    advice = "Meant? Then `python tests/guards/public_names.py --update`, and a line in CHANGELOG.md for the user."
    assert not changes, f"the public names changed:\n{changes}\n{advice}"


def test_the_snapshot_sees_signatures_fields_and_methods():
    text = snapshot()
    assert len(reference_modules()) > 30
    for part in (
        "propagate_fresnel(field: Complex[Array, 'y x'], *, distance_m: float, wavelength_m: float, pixel_m: float)",
        "opd_m: Float[Array, '*frame y x']",
        "@property outcome(self) -> Outcome",
        "CONVERGED",
    ):
        assert part in text
