"""Compiled code is kept for the tests that follow, and goes with them."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def _compiled_code_beside_the_tests(tmp_path_factory):
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    del os.environ["XDG_CACHE_HOME"]
    if before is not None:
        os.environ["XDG_CACHE_HOME"] = before
