"""The paper's three examples: restructured models against those that keep the structure, and what restructuring costs.

    python benchmarks/structure.py

Agreement of the accelerations first, then time per sample, one at a time and in batches, on one core; then the edit.
results/structure.json.
"""

import harness

BATCH, ROUNDS = 64, 9


def one_example(models) -> list[dict]:
    """A row for each model: size, disagreement with the first one, times, and how many times slower than the first."""
    import jax
    import numpy as np

    want, rows, single, many = None, [], {}, {}
    for name, m in models.items():
        vdot = m.accelerations()
        want = vdot if want is None else want
        rows.append(dict(model=name, coordinates_and_rows=m.size))
        if np.shape(vdot) == np.shape(want):
            rows[-1]["disagreement"] = float(np.abs(vdot - want).max() / np.abs(want).max())
        f, state = m.f, (m.q, m.v, m.tau)
        batched, wide = jax.vmap(f, (None, 0, 0, 0)), tuple(np.tile(x, (BATCH, 1)) for x in state)
        single[name] = harness.Contender(harness.loop(lambda chain, x, f=f: f(chain, *x), m.chain, state), 1)
        many[name] = harness.Contender(harness.loop(lambda chain, x, f=batched: f(chain, *x), m.chain, wide), BATCH)
    for key, contenders in (("single", single), (f"batch_{BATCH}", many)):
        times, _ = harness.times(contenders, ROUNDS)
        for row in rows:
            row[key] = harness.spread(times[row["model"]])
            row[f"{key}_ratio"] = harness.ratio(times[row["model"]], times[rows[0]["model"]])
    return rows


def edits() -> dict[str, dict]:
    """Edit and pack, for each example's change of structure, within one capacity [us]."""
    import examples
    import jax
    import numpy as np

    import sdyn

    full = sdyn.models.load("paper37")
    idle = {joint.name: 0.3 for joint in full.moving if joint.name not in examples.ACTIVE}
    _, robot = examples.flyer()
    free, *_ = examples.steps_2().values()
    hand = free.frame("hand1").link
    changes = {
        "Example 1": (robot, lambda: robot.reroot("fixture").ground("grip")),
        "Example 2": (free, lambda: free.close("hand2", "hand1").reroot(hand).ground("hand1").close("hand3", "ground")),
        "Example 3": (full, lambda: full.lock(idle)),
    }
    out = {}
    for name, (before, edit) in changes.items():
        size = sdyn.capacity([before, edit()])
        f = harness.calls(lambda edit=edit, size=size: jax.block_until_ready(sdyn.pack(edit(), size)))
        out[name] = harness.spread(np.array([harness.seconds(f, 1) for _ in range(100)]))
    return out


def main():
    harness.one_thread()
    import examples

    out = dict(what=__doc__.split("\n")[0], machine=harness.machine(), batch=BATCH, rounds=ROUNDS, examples={})
    for title, example in examples.EXAMPLES.items():
        print(title)
        rows = out["examples"][title] = one_example(example())
        for row in rows:
            single, many = row["single"]["median_us"], row[f"batch_{BATCH}"]["median_us"]
            print(
                f"  {row['model']:42s} {row['coordinates_and_rows']:>8s}"
                f"  {single:9.1f} us ({row['single_ratio']:5.2f} x)"
                f"  batch {many:8.2f} us ({row[f'batch_{BATCH}_ratio']:5.2f} x)"
                f"  {row.get('disagreement', 0):.0e}"
            )
    out["edit_and_pack"] = edits()
    for name, row in out["edit_and_pack"].items():
        print(f"  {name}: edit and pack {row['median_us'] / 1e3:.2f} ms")
    harness.save("structure", out)


if __name__ == "__main__":
    main()
