"""The reference data in `data/`, in the conventions of `sdyn`.

`treeN*` hold free trees of N joints and 20 states of them, computed by a plain Newton-Euler program in world
coordinates (mass matrix from unit accelerations, accelerations by Cholesky, derivatives by the complex step) that
shares no code with `sdyn`; `top_*` are torque-free tops in quadruple precision; `free_floater_two_body` is a closed
form.

Their velocity is [v of the base, w of the base, joint rates], linear first; Jacobians and accelerations of points have
rows [linear; angular]. Everything returned here is angular first.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"
TREES = ("tree7", "tree11", "tree17")


@cache
def model(name) -> dict:
    """The description of a tree: links with joint to the parent, end-effectors."""
    return json.loads((DATA / f"{name}.json").read_text())


@cache
def raw(name) -> dict:
    """The arrays of a file as they are."""
    with np.load(DATA / f"{name}.npz", allow_pickle=False) as data:
        return {key: data[key] for key in data.files}


@cache
def tree(name) -> dict:
    """The arrays of a file of a tree, angular first; q is the whole configuration."""
    data = dict(raw(name))
    for key, x in data.items():
        if key.startswith(("nu", "tau", "bias", "orig_nudot", "Jdot_nu", "link_com_acc")):
            data[key] = swap(x, -1)
        if key.startswith(("M", "dnudot", "J_ee")):
            data[key] = swap(swap(x, -1), -2)
    if "base_pos" in data:
        data["q"] = np.concatenate([data["base_pos"], data["base_quat_wxyz"], data["q"]], -1)
    return data


def swap(x, axis):
    """The first three entries exchanged with the next three."""
    x = np.moveaxis(x, axis, 0)
    return np.moveaxis(np.concatenate([x[3:6], x[:3], x[6:]]), 0, axis)


def wrenches(data, links, origin):
    """The applied wrench as [n; f] per link, about the links' origins [20, n, 3]."""
    out = np.zeros((len(links), origin.shape[1], 6))
    for k, link in enumerate(links):
        force, arm = data["wrench_force_world"][k], data["wrench_point_world"][k] - origin[k, int(link)]
        out[k, int(link)] = np.r_[data["wrench_torque_world"][k] + np.cross(arm, force), force]
    return out


def about(centre, momentum_at_origin, linear):
    """Angular momentum about the centre of mass, from that about the origin."""
    return momentum_at_origin - np.cross(centre, linear)
