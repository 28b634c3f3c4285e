"""Compiled code is kept for the tests that follow, and goes with them; the precision of JAX is put back."""

import os

import jax
import pytest


@pytest.fixture(autouse=True)
def _precision_as_before():
    """A point that runs in this process sets its own, which the tests of other files would meet."""
    yield
    jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session", autouse=True)
def _compiled_code_beside_the_tests(tmp_path_factory):
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    del os.environ["XDG_CACHE_HOME"]
    if before is not None:
        os.environ["XDG_CACHE_HOME"] = before
