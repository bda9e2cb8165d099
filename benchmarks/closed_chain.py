"""Two arms of seven joints that hold each other on a free base (20 coordinates, 6 closure rows): accelerations and
their gradient, next to Pinocchio's `constraintDynamics` and `computeConstraintDynamicsDerivatives`.

Same system, same states, same run, one thread; the agreement comes first. Pinocchio is called from Python sample by
sample, which costs it about a microsecond for each. Ours is a batch of 256.
"""

import harness

harness.one_thread()

import jax  # noqa: E402
import numpy as np  # noqa: E402
import peers  # noqa: E402
import subjects  # noqa: E402

import sdyn  # noqa: E402

COUNT = 256


def closed_states(count: int):
    """The robot, and states in which its hands hold each other."""
    rng = np.random.default_rng(0)
    robot = subjects.arms(2, 7)
    q = np.concatenate([np.zeros(3), [1.0, 0, 0, 0], rng.uniform(-0.8, 0.8, 14)])
    hands = [sdyn.Frame(f"hand{k}", f"l{k}_6", position=(0, 0, 0.1)) for k in (0, 1)]
    robot = robot.close(*hands, q=q, name="grip")
    chain = sdyn.pack(robot)
    base = rng.normal(size=(count, 7))
    base[:, 3:] /= np.linalg.norm(base[:, 3:], axis=1, keepdims=True)
    near = np.concatenate([base, q[7:] + 0.1 * rng.normal(size=(count, 14))], 1)
    q, v = jax.jit(jax.vmap(sdyn.project, (None, 0, 0)))(chain, near, rng.normal(size=(count, 20)))
    tau = rng.normal(size=(count, 20)) * (np.arange(20) >= 6)
    return robot, chain, np.asarray(q), np.asarray(v), tau


class Pinocchio(peers.Pinocchio):
    """With one rigid closure, between the frames of a loop."""

    def __init__(self, robot, q, v, tau):
        super().__init__(robot, q, v, tau)
        pin, loop = self.pin, robot.loops[0]
        ends = []
        for end in (loop.frame_a, loop.frame_b):
            joint = next(j for j in robot.joints if j.child == end.link)
            ends += [self.model.getJointId(joint.name), pin.SE3(end.rotation, end.position)]
        self.models = pin.StdVec_RigidConstraintModel()
        self.models.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_6D, self.model, *ends, pin.LOCAL))
        self.datas = pin.StdVec_RigidConstraintData()
        self.datas.append(self.models[0].createData())
        pin.initConstraintDynamics(self.model, self.data, self.models, self.datas)
        self.settings = pin.ProximalSettings(1e-12, 1e-12, 1e-10, 10)

    def acceleration(self, k):
        state = self.q[k], self.v[k], self.tau[k]
        return self.pin.constraintDynamics(self.model, self.data, *state, self.models, self.datas, self.settings)

    def gradient(self, k):
        self.acceleration(k)
        self.pin.computeConstraintDynamicsDerivatives(self.model, self.data, self.models, self.datas, self.settings)


def main():
    robot, chain, q, v, tau = closed_states(COUNT)
    w = np.random.default_rng(1).normal(size=20)
    residual = jax.jit(jax.vmap(sdyn.loop_residual, (None, 0)))(chain, q)
    held = sdyn.forward_dynamics
    ours = lambda chain, x: jax.vmap(held, (None, 0, 0, 0))(chain, *x)
    along = jax.grad(lambda x, chain, w: w @ held(chain, *x))
    slope = lambda fixed, x: jax.vmap(along, (0, None, None))(x, *fixed)
    pin = Pinocchio(robot, q, v, tau)
    want = pin.vdot()
    error = float(np.abs(jax.jit(ours)(chain, (q, v, tau)) - want).max() / np.abs(want).max())
    print(f"closures {np.abs(residual).max():.1e}, accelerations differ by {error:.1e}")

    def every(f):
        def run(n):
            for _ in range(n):
                for k in range(COUNT):
                    f(k)

        return run

    contenders = {
        "sdyn accelerations": harness.Contender(harness.loop(ours, chain, (q, v, tau)), COUNT),
        "Pinocchio accelerations": harness.Contender(every(pin.acceleration), COUNT),
        "sdyn gradient": harness.Contender(harness.loop(slope, (chain, w), (q, v, tau)), COUNT),
        "Pinocchio gradient": harness.Contender(every(pin.gradient), COUNT),
    }
    times, first = harness.times(contenders)
    result = dict(machine=harness.machine("pin"), error=error, first_call_s=first)
    for what in ("accelerations", "gradient"):
        mine, theirs = times[f"sdyn {what}"], times[f"Pinocchio {what}"]
        result[what] = dict(
            sdyn=harness.spread(mine), Pinocchio=harness.spread(theirs), times_faster=harness.ratio(theirs, mine)
        )
        print(what, result[what])
    harness.save("closed_chain", result)


if __name__ == "__main__":
    main()
