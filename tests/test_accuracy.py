"""The dial: what its presets deliver against references, and that a wanted error is met by measuring."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from structures import QUICKLY, UNBALANCED, close, states, tree

import sdyn
from sdyn.choose import distance


@pytest.mark.slow
def test_the_reference_on_andrews():
    """1e-11 in q(0.03), in quadruple precision."""
    chain, (q, v), force, dt, _ = scenes.andrews()
    qs, vs = jax.jit(lambda: sdyn.rollout(chain, q[0], v[0], force, dt, steps=30, accuracy="reference"))()
    close(qs[-1], q[-1], 1e-11)
    close(vs[-1], v[-1], 1e-11)
    assert np.abs(sdyn.loop_residual(chain, qs[-1])).max() < 1e-12


def test_what_a_dial_means():
    """Substeps divide the step; frame and type are those of the dial; gradients that are recomputed are the same."""
    model = tree(UNBALANCED[:3])
    chain, x = sdyn.pack(model), states(model, "dial")
    taus = 0.1 * np.ones((4, chain.nv))
    roll = lambda tau, n=4, dt=0.02, **rest: sdyn.rollout(chain, x.q[0], 0.3 * x.v[0], tau[:n], dt, **rest)
    fine = jax.jit(partial(roll, np.tile(taus, (2, 1)), 8, 0.01), **QUICKLY)()
    for accuracy in (sdyn.Accuracy(substeps=2), sdyn.Accuracy(substeps=2, derivatives="recomputed")):
        coarse = jax.jit(partial(roll, taus, accuracy=accuracy), **QUICKLY)()
        for a, b in zip(coarse, fine, strict=True):
            close(a, b[::2], 1e-14)
    other = jax.jit(partial(roll, taus, accuracy=sdyn.Accuracy(substeps=2, frame="link")), **QUICKLY)()
    close(other[0], fine[0][::2], 1e-13)
    single = jax.jit(partial(roll, taus, accuracy="fast"), **QUICKLY)()
    assert single[0].dtype == np.float32
    close(single[0], roll(taus, accuracy="balanced")[0], 1e-5)
    slopes = [
        jax.jit(jax.grad(lambda tau, a=a: roll(tau, accuracy=a)[1][-1].sum()), **QUICKLY)(jnp.asarray(taus))
        for a in (sdyn.Accuracy(), sdyn.Accuracy(derivatives="recomputed"))
    ]
    close(slopes[1], slopes[0], 1e-13)


def test_what_the_adaptive_method_gives_up():
    """A fast top takes more than 4096 steps for 1000 s: that is said, and nothing is NaN, nor taken for a truth."""
    chain, (q, v), force, _, _ = scenes.fast_top()
    options = dict(steps=3, accuracy="reference")
    qs, vs = jax.jit(lambda: sdyn.rollout(chain, q[0], v[0], force, 1000.0, **options), **QUICKLY)()
    assert np.isfinite(qs[0]).all() and np.isposinf(qs[1:]).all() and np.isposinf(vs[1:]).all()
    found = sdyn.diagnose(chain, qs, vs)
    assert found.bad_step == 1 and "State 1 is bad: the adaptive method ran out of steps" in str(found)
    with pytest.raises(ValueError, match="the reference itself breaks"):
        sdyn.choose(chain, q[0], v[0], force, 1000.0, "1e-6", steps=3)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(method="euler"), "method is 'euler'"),
        (dict(dtype="float16"), "dtype is 'float16'"),
        (dict(frame="elbow"), "frame is 'elbow'"),
        (dict(loops="newton"), "loops is 'newton'"),
        (dict(drift="ignore"), "drift is 'ignore'"),
        (dict(substeps=0), "substeps is 0"),
    ],
)
def test_what_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        sdyn.Accuracy(**given)


def test_what_a_rollout_refuses():
    model = tree(())
    chain = sdyn.pack(model)
    roll = partial(sdyn.rollout, chain, model.neutral(), np.zeros(6), np.zeros((2, 6)), 0.1)
    with pytest.raises(ValueError, match="one of fast, balanced, accurate, reference, a wanted error"):
        roll(accuracy="precise")
    with pytest.raises(ValueError, match="above 0"):
        roll(accuracy="-1e-3")
    with pytest.raises(ValueError, match="cannot under jit"):
        jax.jit(lambda v: sdyn.rollout(chain, model.neutral(), v, np.zeros((2, 6)), 0.1, accuracy="1e-6"))(np.zeros(6))


# -- a wanted error ----------------------------------------------------------------------------------------------------


OTHERS = scenes.four_bar, scenes.governor, scenes.andrews, scenes.pendulum
SLOW = [pytest.param(f, marks=pytest.mark.slow) for f in OTHERS]


@pytest.mark.parametrize("scene", [scenes.top, *SLOW])
def test_a_wanted_error_is_met(scene):
    """1e-6 against the reference of the literature. What it costs is in `benchmarks/results/accuracy.json`."""
    chain, truth, force, dt, gravity = scene()
    q, v = (x[0] for x in truth)
    steps = len(truth[0]) - 1
    found = sdyn.choose(chain, q, v, force, dt, "1e-6", steps=steps, gravity=gravity)
    roll = jax.jit(partial(sdyn.rollout, steps=steps, accuracy=found.accuracy, gravity=gravity), static_argnums=3)
    error = distance(scenes.unsigned(roll(chain, q, v, force, dt), truth), truth)
    assert error <= 1.01e-6, (error, found.accuracy)
    assert found.seconds == min(x.seconds for x in found.tried if x.error <= 1e-6)
