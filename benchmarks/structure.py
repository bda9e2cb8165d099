"""The paper's three examples: restructured models against those that keep the structure and constrain it.

    python benchmarks/structure.py

Agreement of the accelerations first, then time per sample, one at a time and in batches, on one core; what an edit
costs is in structure_change.py. results/structure.json.
"""

import harness

BATCH, ROUNDS = 64, 9


def one_example(models) -> list[dict]:
    """A row for each model: size, disagreement with the first one, times, and how many times slower than the first."""
    import jax
    import numpy as np

    want, rows, single, many = None, [], {}, {}
    for name, m in models.items():
        rows.append(dict(model=name, coordinates_and_rows=m.size))
        if m.shared is not None:
            vdot = m.accelerations()
            want = vdot if want is None else want
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
                f"  {'' if 'disagreement' not in row else format(row['disagreement'], '.0e')}"
            )
    harness.save("structure", out)


if __name__ == "__main__":
    main()
