"""Planar mechanisms of the literature as robots, and how far their states are from the reference data."""

import json

import jax.numpy as jnp
import numpy as np
import oracles

import sdyn


def pin(name, parent, child, x, y=0.0, axis=(0.0, 0.0, 1.0)):
    """A revolute joint at a point of its parent."""
    return sdyn.Joint(name, "revolute", parent, child, position=(x, y, 0.0), axis=axis)


def bar(name, mass, com, inertia):
    """A body of the plane, of a thickness that does not matter."""
    return sdyn.Link(name, mass, (*com, 0.0), np.diag([0.5, 0.5, 1.0]) * inertia)


def tip(name, link, x, y=0.0):
    return sdyn.Frame(name, link, position=(x, y, 0.0))


def four_bar(kind="revolute") -> sdyn.Robot:
    """The one of RigidBodyDynamics.jl: crank, coupler (relative to the crank) and rocker; in x and y."""
    l0, l1, l2, l3 = 1.10, 0.5, 1.20, 0.75
    links = [
        sdyn.Link("ground_bar", 0.0),
        bar("crank", 0.5, (0.25, 0), 0.333),
        bar("coupler", 1.0, (0.60, 0), 0.537),
        bar("rocker", 0.75, (0.375, 0), 0.4),
    ]
    joints = [
        pin("theta", "ground_bar", "crank", 0.0),
        pin("gamma", "crank", "coupler", l1),
        pin("phi", "ground_bar", "rocker", l0),
    ]
    robot = sdyn.Robot(links, joints, grounded=True)
    return robot.close(tip("of_coupler", "coupler", l2), tip("of_rocker", "rocker", l3), kind, name="pin")


def row_of_four_bars(count, kind="point") -> sdyn.Robot:
    """IFToMM A02: unit rods of 1 kg on unit spacing, singular when all are aligned with x."""
    rod = lambda name: bar(name, 1.0, (0.5, 0), 1 / 12)
    links = [sdyn.Link("ground_bar", 0.0), *(rod(f"rod{k}") for k in range(count + 1))]
    links += [rod(f"bar{k}") for k in range(count)]
    joints = [pin(f"a{k}", "ground_bar", f"rod{k}", k) for k in range(count + 1)]
    joints += [pin(f"b{k}", f"rod{k}", f"bar{k}", 1.0) for k in range(count)]
    robot = sdyn.Robot(links, joints, grounded=True)
    for k in range(count):
        robot = robot.close(tip(f"end{k}", f"bar{k}", 1.0), tip(f"top{k}", f"rod{k + 1}", 1.0), kind, name=f"pin{k}")
    return robot


def bricard() -> sdyn.Robot:
    """IFToMM A04: six revolute joints of which the closure leaves one degree of freedom, although it has five rows."""
    model = json.loads((oracles.DATA / "bricard_robot.json").read_text())["links"]
    links = [sdyn.Link(f"l{k}", x["mass"], x["com"], x["inertia_com"]) for k, x in enumerate(model)]
    place = lambda x: (x["joint"]["X_parent_joint"]["R"], x["joint"]["X_parent_joint"]["p"], x["joint"]["axis"])
    joints = [sdyn.Joint(f"j{k}", "revolute", f"l{x['parent']}", f"l{k}", *place(x)) for k, x in enumerate(model) if k]
    z_to_x = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    ends = sdyn.Frame("last", "l5", z_to_x, (0, 1, 0)), sdyn.Frame("wall", "ground", z_to_x, (0, 0, 1))
    return sdyn.Robot(links, joints, grounded=True).close(*ends, "revolute", name="sixth")


ANDREWS = ("beta", "theta", "gamma", "phi", "delta", "omega", "epsilon")


def andrews() -> tuple[sdyn.Robot, dict]:
    """The squeezer of the test set for initial value problems, and its constants; the spring acts on gamma."""
    p = {k: float(x) for k, x in json.loads((oracles.DATA / "andrews.json").read_text())["parameters"].items()}
    com = {
        1: (p["ra"], 0), 2: (-p["da"], 0), 3: (p["sb"], -p["sa"]), 4: (0, p["ea"] - p["e"]), 5: (p["ta"], p["tb"]),
        6: (p["zf"] - p["fa"], 0), 7: (-p["ub"], -p["ua"]),
    }  # fmt: skip
    links = [sdyn.Link("k0", 0.0), *(bar(f"k{i}", p[f"m{i}"], com[i], p[f"i{i}"]) for i in com)]
    joints = [
        pin("beta", "k0", "k1", 0.0),
        pin("theta", "k1", "k2", p["rr"]),
        pin("gamma", "k0", "k3", p["xb"], p["yb"]),
        pin("phi", "k5", "k4", p["zt"]),
        pin("delta", "k0", "k5", p["xa"], p["ya"]),
        pin("omega", "k7", "k6", 0.0, -p["u"]),
        pin("epsilon", "k0", "k7", p["xa"], p["ya"]),
    ]
    robot = sdyn.Robot(links, joints, grounded=True)
    for k, x, y in ((3, 0.0, -p["ss"]), (4, 0.0, -p["e"]), (6, p["zf"], 0.0)):
        robot = robot.close(tip("e2", "k2", -p["d"]), tip(f"e{k}", f"k{k}", x, y), "point", name=f"pin{k}")
    return robot, p


def andrews_force(p):
    """The drive and the spring of the squeezer, a function (t, q, v)."""

    def force(t, q, v):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        x, y = p["xb"] + p["sc"] * s + p["sd"] * c - p["xc"], p["yb"] - p["sc"] * c + p["sd"] * s - p["yc"]
        length = jnp.hypot(x, y)
        pull = -p["c0"] * (length - p["l0"]) / length
        turn = x * (p["sc"] * c - p["sd"] * s) + y * (p["sd"] * c + p["sc"] * s)
        return jnp.zeros(7, q.dtype).at[0].set(p["mom"]).at[2].set(pull * turn)

    return force


def double_pendulum() -> sdyn.Robot:
    """Unit point masses on unit rods without mass; angles from straight down, the second relative to the first."""
    ball = lambda name: sdyn.Link(name, 1.0, (0.0, -1.0, 0.0))
    joints = [pin("a", "ground_bar", "upper", 0.0), pin("b", "upper", "lower", 0.0, -1.0)]
    return sdyn.Robot([sdyn.Link("ground_bar", 0.0), ball("upper"), ball("lower")], joints, grounded=True)


def flyball():
    """IFToMM A05: a governor whose rods a slider holds by stiff springs and dampers; with its force (t, q, v)."""
    model = json.loads((oracles.DATA / "flyball_robot.json").read_text())
    links = [sdyn.Link(f"l{k}", x["mass"], x["com"], x["inertia_com"]) for k, x in enumerate(model["links"])]
    place = lambda x: (x["X_parent_joint"]["R"], x["X_parent_joint"]["p"], x["axis"])
    joints = [
        sdyn.Joint(x["joint"]["name"], x["joint"]["type"], f"l{x['parent']}", f"l{k}", *place(x["joint"]))
        for k, x in enumerate(model["links"]) if k
    ]  # fmt: skip

    def force(t, q, v):
        """In the plane of the rods: the slider's end at (w, s), the middle of a rod at (w + r sin a, 1 - r cos a)."""
        (spring, _), tau = model["springs"], jnp.zeros(4, q.dtype)
        r = -spring["point_b"][2]
        for k in (2, 3):
            s, c = jnp.sin(q[k]), jnp.cos(q[k])
            x, z = r * s, 1 - r * c - q[1]
            length = jnp.sqrt(x * x + z * z)
            rate = (x * r * c * v[k] + z * (r * s * v[k] - v[1])) / length
            pull = spring["k"] * (length - spring["rest"]) + spring["c"] * rate
            tau = tau.at[1].add(pull * z / length).at[k].add(-pull * (x * r * c + z * r * s) / length)
        return tau

    return sdyn.Robot(links, joints, grounded=True), force
