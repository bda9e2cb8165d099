"""How all benchmarks measure: one thread, contenders in turn, medians with their spread, the machine named.

A shared machine drifts: so what is to be compared is timed in turns, round after round, and a ratio is the median of
the ratios within a round.
"""

import gc
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

RESULTS = Path(__file__).parent / "results"
ROUNDS, LEAST = 15, 0.03  # of each contender; seconds that one timing lasts at least
ONE_THREAD = dict(
    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    OMP_NUM_THREADS="1",
    OPENBLAS_NUM_THREADS="1",
    JAX_PLATFORMS="cpu",
    JAX_ENABLE_X64="1",
)


def one_thread():
    """Keep this process, and what it starts, to one thread on one core; before JAX is imported."""
    os.environ |= ONE_THREAD
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


class Contender(NamedTuple):
    """Something to be timed."""

    run: Callable[[int], object]
    """Does the work so many times and returns when all of it is done."""
    samples: int
    """Samples in one of these times."""


def loop(f, fixed, x):
    """`f(fixed, x)` over and over in one compiled loop; each turn waits for the last, through all of `x`.

    What does not change in a loop, XLA moves out of it, and what is not used, it leaves out: so every array of x
    changes by a trillionth of the results, and every entry of them is used.

    Args:
        f: Returns arrays [..., k], some of them of the shape of one in x.
        fixed, x: Pytrees of arrays; copied to the device once.
    """
    import jax

    fixed, x = jax.device_put((fixed, x))

    def nudged(a, results):
        alike = [y for y in results if y.shape == a.shape] or [y[..., :1] for y in results]
        return a + (1e-12 * sum(alike)).astype(a.dtype)

    def turn(fixed, x):
        results = jax.tree.leaves(f(fixed, x))
        return jax.tree.map(lambda a: nudged(a, results), x)

    turns = jax.jit(lambda n, fixed, x: jax.lax.fori_loop(0, n, lambda _, x: turn(fixed, x), x))
    return lambda n: jax.block_until_ready(turns(n, fixed, x))


def calls(f):
    """`f()` over and over from Python."""

    def run(n):
        for _ in range(n):
            f()

    return run


def seconds(run: Callable[[int], object], n: int) -> float:
    """How long it runs."""
    start = time.perf_counter()
    run(n)
    return time.perf_counter() - start


def times(contenders: dict[str, Contender], rounds: int = ROUNDS) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Seconds per sample of each contender in each round, and the seconds of its first call, which may compile."""
    turns, first = dict.fromkeys(contenders, 1), {}
    for name, contender in contenders.items():
        first[name] = round(seconds(contender.run, 1), 3)
        while seconds(contender.run, turns[name]) < LEAST:
            turns[name] *= 2
    out = {name: [] for name in contenders}
    gc.collect()
    gc.disable()
    for _ in range(rounds):
        for name, contender in contenders.items():
            out[name].append(seconds(contender.run, turns[name]) / turns[name] / contender.samples)
    gc.enable()
    return {name: np.array(x) for name, x in out.items()}, first


def spread(x) -> dict[str, float]:
    """Median, 10th and 90th percentile of seconds, in microseconds."""
    low, median, high = (round(float(y), 4) for y in np.percentile(1e6 * np.asarray(x), (10, 50, 90)))
    return dict(median_us=median, p10_us=low, p90_us=high)


def ratio(slow, fast) -> float:
    """How many times faster the second is: the median over the rounds."""
    return round(float(np.median(np.asarray(slow) / np.asarray(fast))), 3)


def machine(*packages: str) -> dict:
    """What was measured on."""
    cpu = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    versions = {}
    for package in ("sdyn", "jax", "jaxlib", "numpy", *packages):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return dict(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        cpu=cpu,
        cores=os.cpu_count(),
        load=round(os.getloadavg()[0], 2),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        versions=versions,
    )


def save(name: str, result: dict):
    """Keep a result in results/NAME.json."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
