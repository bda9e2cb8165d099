"""Problems whose solutions are known in closed form, solved by the default solver."""

import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from planners import sqp
from planners.bspline import Clamped
from planners.problem import Block, Form, Problem, Rows, Values


def solved(problem, **x):
    """Where the solver ends from one guess, by name."""
    *_, state = sqp.solve(problem, problem.form.join(x)[None])
    end = sqp.outcome(sqp.pick(state, 0))
    assert end.status == "solved"
    return end, problem.form.split(end.z)


# -- shortest time of a double integrator ------------------------------------------------------------------------------


def bang(x, distance):
    """Two arcs of constant acceleration, of free lengths; rest at the end."""
    (t1, t2), (a1, a2) = x["durations"], x["accelerations"]
    v = a1 * t1
    place = v * t1 / 2 + v * t2 + a2 * t2**2 / 2
    return Values(t1 + t2, jnp.zeros(1), jnp.array([place - distance, v + a2 * t2]), jnp.zeros(0))


def test_the_shortest_time_of_a_double_integrator():
    """From rest to rest over a distance d with |a| <= m: half of the way each, T = 2 sqrt(d / m)."""
    d, m = 3.0, 0.7
    form = Form((Block("durations", (2,)), Block("accelerations", (2,))), bang)
    rows = Rows("place", 1.0, "m", (1,)), Rows("speed", 1.0, "m/s", (1,))
    low, high = {"durations": 0.01, "accelerations": -m}, {"durations": 20.0, "accelerations": m}
    end, x = solved(Problem(form, d, low, high, rows, ()), durations=[1.0, 3.0], accelerations=[0.3, -0.1])
    assert abs(end.cost - 2 * np.sqrt(d / m)) < 1e-9  # measured 6.7e-12
    assert np.abs(x["accelerations"] - [m, -m]).max() < 1e-9 and np.abs(np.diff(x["durations"])).max() < 1e-8


# -- a plastic grasp at a free time ------------------------------------------------------------------------------------


def caught(x, data):
    """A chaser pushes off towards a drifting target, and holds it at a free time; both then drift as one."""
    t, v = x["time"][0], x["velocity"][0]
    m1, m2, d, v2, weight = data
    after = (m1 * v + m2 * v2) / (m1 + m2)
    lost = (m1 * v**2 + m2 * v2**2 - (m1 + m2) * after**2) / 2
    return Values(weight * t + lost, jnp.zeros(1), jnp.array([v * t - d - v2 * t]), jnp.zeros(0))


def test_the_plastic_grasp_of_two_bodies_at_a_free_time():
    """The energy lost is mu u^2 / 2 at the relative velocity u = d / t, so w t + mu d^2 / (2 t^2) is least at
    t = (mu d^2 / w)^(1/3)."""
    m1, m2, d, v2, w = 100.0, 50.0, 4.0, 0.2, 0.3
    form = Form((Block("time", (1,), 10.0), Block("velocity", (1,))), caught)
    problem = Problem(form, (m1, m2, d, v2, w), {"time": 0.1}, {"time": 200.0}, (Rows("place", 1.0, "m", (1,)),), ())
    end, x = solved(problem, time=[20.0], velocity=[0.5])
    t = (m1 * m2 / (m1 + m2) * d**2 / w) ** (1 / 3)
    assert abs(x["time"][0] / t - 1) < 1e-6 and abs(x["velocity"][0] - v2 - d / t) < 1e-6  # measured 7e-10, 3e-10
    assert abs(end.cost - 1.5 * w * t) < 1e-6


# -- rendezvous path with cost of time, rate and acceleration ----------------------------------------------------------

DISTANCE, W1, W2 = 2.0, 3.0, 5.0  # m, s^2/m^2, s^4/m^2
SPLINE, (NODES, WEIGHTS) = Clamped(24), np.polynomial.legendre.leggauss(6)


def exponential_path(T):
    """r(t) = k0 + k1 t + k2 e^(s t) + k3 e^(-s t), s = sqrt(w1 / w2), from rest to rest: (r, r', r'') at times t."""
    s = np.sqrt(W1 / W2)
    basis = lambda t: np.array(
        [
            [1 + 0 * t, t, np.exp(s * t), np.exp(-s * t)],
            [0 * t, 1 + 0 * t, s * np.exp(s * t), -s * np.exp(-s * t)],
            [0 * t, 0 * t, s**2 * np.exp(s * t), s**2 * np.exp(-s * t)],
            [0 * t, 0 * t, s**3 * np.exp(s * t), -(s**3) * np.exp(-s * t)],
        ]
    )
    k = np.linalg.solve(np.concatenate([basis(0.0)[:2], basis(T)[:2]]), [0.0, 0.0, DISTANCE, 0.0])
    return lambda t: np.einsum("oi...,i->o...", basis(np.asarray(t, float)), k)


def hamiltonian(T):
    """At the end of the path, where it rests; zero where its duration is best."""
    return 1 - W2 * exponential_path(T)(T)[2] ** 2


def rendezvous(x, data):
    """The same as a spline of free duration, the integral by Gauss's rule in every span: exact for it."""
    T, still, (points, weights) = x["duration"][0], jnp.zeros(2), quadrature()
    P = jnp.concatenate([still, x["inner"], still + DISTANCE])
    rate, acceleration = (jnp.asarray(SPLINE.basis(points, k)) @ P / T**k for k in (1, 2))
    root = jnp.sqrt(2 * weights * T)
    residual = jnp.concatenate([jnp.sqrt(W1) * root * rate, jnp.sqrt(W2) * root * acceleration])
    return Values(T, residual, jnp.zeros(0), jnp.zeros(0))


def quadrature():
    knots = np.unique(SPLINE.knots)
    half = np.diff(knots)[:, None] / 2
    return (knots[:-1, None] + half * (NODES + 1)).ravel(), (half * WEIGHTS).ravel()


def test_the_rendezvous_path_with_cost_of_time_rate_and_acceleration():
    """Minimise the integral of 1 + w1 r'^2 + w2 r''^2 with free duration: exponentials (Aghili's path), H(T) = 0."""
    form = Form((Block("duration", (1,), 5.0), Block("inner", (SPLINE.count - 4,))), rendezvous)
    problem = Problem(form, 0.0, {"duration": 0.5}, {"duration": 50.0}, (), ())
    end, x = solved(problem, duration=[6.0], inner=np.linspace(0, DISTANCE, SPLINE.count - 4))
    T = brentq(hamiltonian, 0.5, 50.0, xtol=1e-14)
    path = exponential_path(T)
    points, weights = quadrature()
    _, rate, acceleration, _ = path(points * T)
    cost = T + T * weights @ (W1 * rate**2 + W2 * acceleration**2)
    assert abs(x["duration"][0] / T - 1) < 1e-6 and abs(end.cost / cost - 1) < 1e-6  # 1.1e-8, 9e-13
    s = np.linspace(0, 1, 101)
    P = np.concatenate([np.zeros(2), x["inner"], np.full(2, DISTANCE)])
    assert np.abs(SPLINE.basis(s) @ P - path(s * T)[0]).max() < 1e-6
