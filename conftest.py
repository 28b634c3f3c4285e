"""Tests run in double precision, with every implicit change of dtype or rank forbidden and shapes checked."""

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("nlcwfs", "beartype.beartype")
