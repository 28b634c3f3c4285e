"""The loop over the steps of an iterative method, written once."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array

State = TypeVar("State")


def iterate(step: Callable[[State], State], terminate: Callable[[State], Array], state: State) -> State:
    """Repeat a step until the method says that it is done.

    Examples:
        >>> import jax.numpy as jnp
        >>> int(iterate(lambda n: n * 2, lambda n: n > 100, jnp.asarray(3)))
        192
    """
    return jax.lax.while_loop(lambda state: ~terminate(state), step, state)
