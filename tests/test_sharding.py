"""A batch over several devices by JAX's own `shard_map`: the same numbers, and no device waits for another."""

import subprocess
import sys
from pathlib import Path

CODE = """
import re
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_compilation_cache_dir", CACHE)
import sdyn

links = [sdyn.Link(f"l{k}", 1.0 + k, (0.1, 0.0, 0.2), np.eye(3)) for k in range(3)]
joints = [sdyn.Joint(f"j{k}", "revolute", f"l{k}", f"l{k + 1}", position=(0, 0, 0.3), axis=(1, 0, 0)) for k in range(2)]
robot = sdyn.Robot(links, joints)
chain, rng = sdyn.pack(robot), np.random.default_rng(0)
q, v, tau = rng.normal(size=(6, robot.nq)), rng.normal(size=(6, robot.nv)), rng.normal(size=(6, robot.nv))
q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)

def slopes(chain, q, v, tau):
    return jax.grad(lambda *x: sdyn.forward_dynamics(chain, *x).sum(), (0, 1, 2))(q, v, tau)

QUICKLY = dict(compiler_options={"xla_backend_optimization_level": 0})
mesh = jax.make_mesh((2,), ("batch",))
states = jax.device_put((q, v, tau), jax.NamedSharding(mesh, jax.P("batch")))
for f in (sdyn.forward_dynamics, slopes):
    whole = jax.vmap(f, (None, 0, 0, 0))
    spread = jax.shard_map(whole, mesh=mesh, out_specs=jax.P("batch"), check_vma=False)
    program = jax.jit(spread, **QUICKLY).lower(chain, *states).compile()
    text = program.as_text()
    assert "num_partitions=2" in text
    assert not re.search(r"all-gather|all-reduce|all-to-all|collective|reduce-scatter|send|recv", text)
    found = program(chain, *states)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(jax.jit(whole, **QUICKLY)(chain, q, v, tau))):
        assert len(x.sharding.device_set) == 2 and x.sharding.shard_shape(x.shape)[0] == 3
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-13)  # measured 0
print("spread")
"""


def test_a_batch_over_two_devices():
    """Forward dynamics and its gradient; each device has half of the batch, and the program has no collective."""
    root = Path(__file__).parents[1]
    code = f"CACHE = {str(root / '.cache' / 'jax')!r}\n{CODE}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout == "spread\n", done.stderr
