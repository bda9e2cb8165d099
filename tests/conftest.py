"""float64, a compilation cache that makes a second run fast, random numbers that repeat, two workers, and --slow.

Both workers share one cache of compilations. An entry that the other one is still writing cannot be read; JAX then says
so in a warning and compiles.
"""

import zlib
from pathlib import Path

import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


# What takes longest comes first, so that two workers end together; files stay whole, their tests share programs.
LONGEST = (
    "test_grasp.py", "test_notebooks.py", "test_grasp_planar.py", "test_gradients.py", "test_mechanisms.py",
    "test_closures.py", "test_integrate.py", "test_transfer.py", "test_laws.py", "test_floating.py", "test_hybrid.py",
)  # fmt: skip


def pytest_xdist_auto_num_workers(config):
    """Two, for the cores and the memory of a small machine; for one file none, which starts faster."""
    files = {arg.partition("::")[0] for arg in config.args}
    return 0 if len(files) == 1 and files.pop().endswith(".py") else 2


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests marked slow too")


def pytest_collection_modifyitems(config, items):
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
    if not config.getoption("--slow"):
        slow = [item for item in items if item.get_closest_marker("slow")]
        if slow:
            config.hook.pytest_deselected(items=slow)
            items[:] = [item for item in items if not item.get_closest_marker("slow")]


@pytest.fixture
def rng(request):
    """Random numbers that belong to the test's name."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))
