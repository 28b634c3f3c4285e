"""Tests run in double precision, with every implicit change of dtype or rank forbidden and shapes checked."""

import hypothesis
import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("nlcwfs", "beartype.beartype")

hypothesis.settings.register_profile("here", deadline=None)  # machines are slow when tests share them
hypothesis.settings.load_profile("here")


@pytest.fixture(scope="module", autouse=True)
def _compiled_code_goes_with_its_file():
    """Each program compiled maps memory of its own, and Linux ends a process of more than 65 530 such maps."""
    yield
    jax.clear_caches()
