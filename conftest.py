"""Tests run in double precision, with every implicit change of dtype or rank forbidden and shapes checked."""

import hypothesis
import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("nlcwfs", "beartype.beartype")

hypothesis.settings.register_profile("here", deadline=None)  # machines are slow when tests share them
hypothesis.settings.load_profile("here")
