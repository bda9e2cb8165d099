"""A batch over the cores of the machine by JAX's own sharding, against one device.

    python benchmarks/cores.py

Two lines do it (see `spread`); the library does nothing by hand. Also counts the collectives of the program: none, so
no core waits for another. XLA's threads are as by default here, with one device too: flags that ask for one thread make
the devices take turns.
"""

import os
import re

import harness

BATCH = 4096


def spread(f, mesh, states):
    """The function with its batch over the mesh, and states that are there already."""
    import jax

    states = jax.device_put(states, jax.NamedSharding(mesh, jax.P("batch")))
    return jax.shard_map(f, mesh=mesh, out_specs=jax.P("batch"), check_vma=False), states


def main():
    """Measure, save, show."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    import contenders
    import peers
    import subjects

    import sdyn

    robot = subjects.compared()["paper37"]
    chain, states = sdyn.pack(robot), peers.states(robot, BATCH)
    mesh = jax.make_mesh((os.cpu_count(),), ("batch",))
    slopes = lambda chain, q, v, tau: jax.grad(lambda *x: sdyn.forward_dynamics(chain, *x).sum(), (0, 1, 2))(q, v, tau)
    result = dict(
        what="speed-up of a sharded batch, paper37",
        batch=BATCH,
        **harness.machine(),
        speed_up={},
        collectives={},
        times={},
    )
    for name, f in {"forward dynamics": sdyn.forward_dynamics, "gradient": slopes}.items():
        whole = contenders.batched(f)
        over, there = spread(whole, mesh, states)
        one, every = jax.jit(whole).lower(chain, *states).compile(), jax.jit(over).lower(chain, *there).compile()
        collectives = len(re.findall(r"all-gather|all-reduce|all-to-all|collective-permute", every.as_text()))
        call = lambda program, x: harness.calls(lambda: jax.block_until_ready(program(chain, *x)))
        run = {"one device": (one, states), "all devices": (every, there)}
        times, _ = harness.times({key: harness.Contender(call(*x), BATCH) for key, x in run.items()})
        result["speed_up"][name] = harness.ratio(*times.values())
        result["collectives"][name] = collectives
        result["times"][name] = {key: harness.spread(x) for key, x in times.items()}
        print(f"{name}: {result['speed_up'][name]:.2f} times on {len(mesh.devices)} devices, {collectives} collectives")
    harness.save("cores", result)


if __name__ == "__main__":
    main()
