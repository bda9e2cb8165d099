"""Shapes and types of arguments, checked while tracing."""

import jax.numpy as jnp

from sdyn.chain import Chain


def expect(chain: Chain, **arrays) -> tuple:
    """The arguments as arrays of the chain's type.

    Args:
        chain: Tells the sizes and the type.
        **arrays: Named q, v, vdot, tau, b, gravity or f_ext; rates, accelerations or torques of the joints alone;
            momentum or wrench. None stays None.

    Raises:
        ValueError: If a shape or a floating-point type differs; it names the expected and the given one.
    """
    if chain.slot_index.ndim != 3:
        raise ValueError("the chain is a stacked family; run over it with jax.vmap(f, in_axes=(0, ...)).")
    shapes = {"q": (chain.nq,), "gravity": (3,), "f_ext": (chain.capacity.links, 6), "momentum": (6,), "wrench": (6,)}
    shapes |= dict.fromkeys(("rates", "accelerations", "torques"), (chain.capacity.nv,))
    out = []
    for name, x in arrays.items():
        if x is not None:
            x = jnp.asarray(x) if hasattr(x, "dtype") else jnp.asarray(x, chain.dtype)
            want = shapes.get(name, (chain.nv,))
            if x.shape != want:
                raise ValueError(f"{name} has shape {x.shape}; this structure needs {want} ({_layout(chain)}).")
            if jnp.issubdtype(x.dtype, jnp.floating) and x.dtype != chain.dtype:
                raise ValueError(
                    f"{name} is {x.dtype} and the chain is {chain.dtype}; convert it, or pack with dtype={x.dtype}."
                )
            x = x.astype(chain.dtype)
        out.append(x)
    return tuple(out)


def _layout(chain):
    size = chain.capacity
    base = {"free": "free base", "grounded": "grounded base", "padded": "padded layout, see sdyn.pad"}[size.layout]
    return f"{base}, {size.nq} joint entries of q, {size.nv} of v"
