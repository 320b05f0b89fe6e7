"""The filter against dense Gaussian conditioning, its consistency in 1,000 trials, and the same bits in any batch.

It is the compiled filter that runs, through `OffsetFree.start`. The trials are NumPy's.
"""

from itertools import product
from typing import Any

import hypothesis
import mpmath
import numpy as np
import pytest
from hypothesis import strategies as st
from linear_plans import DT, Linear, double_integrator, linear
from sampling import examples, rarely
from scipy.linalg import expm
from scipy.stats import binom, chi2

import lqrsim as ls
from lqrsim.control.plan_model import PLAUSIBLE, RESOLUTION, PlanDerivatives, PlanModel, kalman_filter
from lqrsim.control.uncertainty import triangular_root
from lqrsim.disturbances import Uncertainty, Unknown
from lqrsim.errors import Array

NOISE: dict[str, Any] = {"measurement": 0.1, "start": 0.3, "control": 0.2}
CONSTANT = Unknown("d0", 0.7)
PASSING = Unknown("d0", 0.5, time_constant=0.4, order=2)
# Unknowns, lag, sensors.
CASES = (
    ((), 0.0, None),
    ((CONSTANT, PASSING), 0.06, None),
    (
        (Unknown("d0", 0.7, time_constant=0.5), Unknown("d0", 0.4, time_constant=0.0)),
        0.06,
        ("s0",),
    ),
    ((CONSTANT, Unknown("offset of u0", 0.2, time_constant=0.3)), 0.0, [[1.0, 0.5]]),
)


def law_of(system: Linear, case: int, *, record: bool = True, **noise: float) -> ls.OffsetFree:
    unknowns, lag, sensors = CASES[case]
    uncertainty = Uncertainty(unknowns=unknowns, lag=lag, **(NOISE | noise))  # type: ignore[arg-type]
    return ls.OffsetFree(
        system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, sensors=sensors, memory=5.0,
        record=record,
    )  # fmt: skip


def conditional(model: PlanModel, inputs: Array, measured: Array, t: int) -> tuple[Array, Array]:
    """E[z_t | y_0 .. y_t] and its covariance, of deviations: one Gaussian of all knots, conditioned by blocks."""
    size, T = model.size, t + 1
    blocks = [model.start_root @ model.start_root.T, *model.process_noise[:t]]
    to = np.zeros((T * size, T * size))  # from the start and the process noise to all z
    known = np.zeros((T, size))
    for i in range(T):
        rows = slice(i * size, (i + 1) * size)
        if i:
            to[rows] = model.step.F[i - 1] @ to[(i - 1) * size : i * size]
            known[i] = model.step.F[i - 1] @ known[i - 1] + model.step.G[i - 1] @ inputs[i - 1] + model.step.c[i - 1]
        to[rows, rows] = np.eye(size)
    noise, H = np.zeros((T * size, T * size)), np.zeros((T * model.sensor.size, T * size))
    V, y = np.zeros((len(H), len(H))), np.zeros(len(H))
    for i in range(T):
        noise[i * size : (i + 1) * size, i * size : (i + 1) * size] = blocks[i]
        seen = slice(i * model.sensor.size, (i + 1) * model.sensor.size)
        H[seen, i * size : i * size + model.n] = model.derivatives.H[i]
        V[seen, seen] = model.derivatives.H[i] @ np.diag(model.measurement_std**2) @ model.derivatives.H[i].T
        y[seen] = model.derivatives.H[i] @ (measured[i] - known[i, : model.n])
    prior = to @ noise @ to.T
    gain = np.linalg.solve(H @ prior @ H.T + V, H @ prior).T
    last = slice(t * size, T * size)
    return known[t] + (gain @ y)[last], (prior - gain @ H @ prior)[last, last]


@hypothesis.given(st.integers(0, len(CASES) - 1), st.integers(0, 10**6), st.booleans())
@hypothesis.settings(max_examples=examples(20))
def test_the_estimate_is_the_dense_conditional_mean(case: int, seed: int, unstable: bool) -> None:
    """Mean and covariance after each measurement, of any plausible numbers: 1e-8 of their size."""
    rng, steps = np.random.default_rng(seed), 6
    rates = rng.normal(size=(2, 2)) + (1.0 if unstable else -2.0) * np.eye(2)
    system = linear(
        rates, rng.normal(size=(2, 1)), rng.normal(size=(2, 1)), start=rng.normal(size=2),
        controls=rng.normal(size=(steps, 1)),
    )  # fmt: skip
    law = law_of(system, case)
    run, plan = law.start(1), system.plan
    off = 0.05 * rng.normal(size=(steps + 1, 2))
    inputs = np.array([run.control(t, (plan.states[t] + off[t])[None])[0] for t in range(steps + 1)])[:steps]
    assert run.estimates is not None
    assert run.innovations is not None
    corrections = np.einsum("tzy,ty->tz", law.filter.gain, run.innovations[:, 0])[:, law.model.n + law.model.lagging :]
    hypothesis.assume((np.abs(corrections) <= law.filter.limit).all())  # larger ones are limited
    for t in range(steps + 1):
        mean, covariance = conditional(law.model, inputs - plan.controls, off, t)
        estimate = run.estimates[t, 0] - law.nominal[t]
        np.testing.assert_allclose(estimate, mean, rtol=0, atol=1e-8 * (1 + np.abs(mean).max()))
        largest = np.abs(covariance).max()
        np.testing.assert_allclose(law.filter.corrected[t], covariance, rtol=0, atol=1e-8 * (1 + largest))


@hypothesis.given(st.sampled_from([1, 2, 3]), st.integers(0, 10**6), st.floats(1.0, 1e6))
@hypothesis.settings(max_examples=examples(20))
def test_an_implausible_measurement_moves_no_unknown_far(case: int, seed: int, times: float) -> None:
    """At most by six standard deviations of a correction, all in proportion; the state is corrected in full.

    These deviations are the differences of the variances before and after the measurement, of which the dense
    conditioning is the reference: 1e-6 of the change, for the differences cancel.
    """
    rng, steps = np.random.default_rng(seed), 5
    system = double_integrator(start=rng.normal(size=2), controls=rng.normal(size=(steps, 1)))
    law = law_of(system, case)
    run, plan, model = law.start(1), system.plan, law.model
    own, jumps = model.n + model.lagging, int(rng.integers(1, steps + 1))
    off = 0.02 * rng.normal(size=(steps + 1, 2))
    off[jumps] *= times
    commands = np.array([run.control(t, (plan.states[t] + off[t])[None])[0] for t in range(jumps + 1)])
    inputs, before = commands[:jumps] - plan.controls[:jumps], jumps - 1
    assert run.estimates is not None
    at = run.estimates[:, 0] - law.nominal
    F, G, c = (part[before] for part in model.step)
    predicted = F @ at[before] + G @ inputs[before] + c
    spread = F @ conditional(model, inputs, off, before)[1] @ F.T + model.process_noise[before]
    mean, left = conditional(model, inputs, off, jumps)
    full, std = mean - predicted, np.sqrt(np.diagonal(spread - left))[own:]
    share = min(1.0, 6.0 * float((std / np.maximum(np.abs(full[own:]), 1e-300)).min()))
    assert PLAUSIBLE == 6.0
    full[own:] *= share
    np.testing.assert_allclose(at[jumps] - predicted, full, rtol=0, atol=1e-6 * np.abs(full).max())


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("times", [10.0, 500.0])
def test_an_unknown_beyond_its_statement_is_found_all_the_same(times: float, noise: float) -> None:
    """A steady push of 10 and 500 standard deviations: a gate that rejects measurements would lock it out.

    After 6 s it is found to 2 % and the noise, of which the estimate has some 0.02 N.
    """
    steps = 60
    system = double_integrator(controls=np.zeros((steps, 1)))
    uncertainty = Uncertainty(unknowns=[Unknown("d0", 0.1)], start=0.01, measurement=noise)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True)
    run, x, rng = law.start(1), system.plan.states[0], np.random.default_rng(0)
    for t in range(steps):
        command = run.control(t, x[None] + noise * rng.normal(size=(1, 2)))[0]
        x = system.A @ x + system.B @ command + system.E @ [0.1 * times]
    assert run.estimates is not None
    np.testing.assert_allclose(run.estimates[steps - 1, 0, -1], 0.1 * times, rtol=0.02, atol=5 * noise)


class Truth:
    """K runs of a double integrator under exactly the stated noise."""

    def __init__(self, law: ls.OffsetFree, system: Linear, trials: int, rng: np.random.Generator) -> None:
        self.system, self.rng, self.uncertainty = system, rng, law.model.uncertainty
        self.inexact = np.asarray(self.uncertainty.control)
        self.mispredicted = np.asarray(self.uncertainty.model_error)
        self.x = system.plan.states[0] + NOISE["start"] * rng.normal(size=(trials, 2))
        self.reached = np.tile(system.plan.controls[0], (trials, 1))
        self.unknowns: list[Array] = []
        for one in self.uncertainty.unknowns:
            width = 0 if one.white else one.order
            self.unknowns.append((1.0 if one.order == 2 else one.std) * rng.normal(size=(trials, width)))

    def measured(self) -> Array:
        return self.x + NOISE["measurement"] * self.rng.normal(size=self.x.shape)

    def z(self, lags: bool) -> Array:
        """As the filter has it."""
        return np.concatenate([self.x, *([self.reached] if lags else []), *self.unknowns], axis=1)

    def step(self, commands: Array) -> None:
        rng, commands = self.rng, commands + self.inexact * self.rng.normal(size=commands.shape)
        push, offset = np.zeros((len(commands), 1)), np.zeros((len(commands), 1))
        for i, one in enumerate(self.uncertainty.unknowns):
            state, step = self.unknowns[i], DT / one.time_constant if one.time_constant else np.inf
            if one.white:
                value = one.std * rng.normal(size=(len(commands), 1))
            elif one.order == 2:
                value = state @ np.array([[0.5], [np.sqrt(3.0) / 2]]) * one.std
                move = expm(step * np.array([[0.0, 1.0], [-1.0, -2.0]]))
                fresh = np.linalg.cholesky(np.eye(2) - move @ move.T)
                self.unknowns[i] = state @ move.T + rng.normal(size=state.shape) @ fresh.T
            else:
                value = state
                fresh = one.std * np.sqrt(1 - np.exp(-2 * step)) + one.drift * np.sqrt(DT)
                self.unknowns[i] = np.exp(-step) * state + fresh * rng.normal(size=state.shape)
            (offset if "offset" in one.name else push)[:] += value
        applied, lag = commands, self.uncertainty.lag
        if lag:
            left = np.exp(-DT / lag)
            applied = commands + (1 - left) * lag / DT * (self.reached - commands)
            self.reached = commands + left * (self.reached - commands)
        self.x = self.x @ self.system.A.T + (applied + offset) @ self.system.B.T + push @ self.system.E.T
        self.x += self.mispredicted * rng.normal(size=self.x.shape)


@pytest.mark.parametrize("case", [0, 3, *rarely(1, 2)])
def test_it_is_consistent_in_a_thousand_trials(case: int) -> None:
    """Mean NEES and NIS over the trials within the 95 % bands of chi-square, knot by knot.

    Of so many knots a few may be out: no more than a binomial with 5 % exceeds once in a thousand. Innovations are
    independent from knot to knot, so for NIS that is exact; errors are not, so for NEES it is a guide.
    """
    trials, steps = 1000, 40
    system = double_integrator(start=[1.0, 0.0], controls=np.sin(np.arange(steps) / 5)[:, None])
    law = law_of(system, case)
    truth = Truth(law, system, trials, np.random.default_rng(case))
    run, true = law.start(trials), []
    for t in range(steps + 1):
        true.append(truth.z(lags=CASES[case][1] > 0))
        truth.step(run.control(t, truth.measured()))
    assert run.estimates is not None
    assert run.innovations is not None
    for values, covariances in ((run.estimates - true, law.filter.corrected), (run.innovations, law.filter.innovation)):
        kept = covariances[0].diagonal() > 0  # what the start is known to be, as what actuators have reached, has none
        means = []
        for t, covariance in enumerate(covariances):
            own = slice(None) if t else kept
            value, inside = values[t][:, own], covariance[own][:, own]
            means.append((value * np.linalg.solve(inside, value.T).T).sum(axis=1).mean() / value.shape[1])
        sizes = [kept.sum()] + [len(kept)] * steps
        low, high = (
            np.array([chi2.ppf(level, trials * one) / (trials * one) for one in sizes]) for level in (0.025, 0.975)
        )
        out = ((np.array(means) < low) | (np.array(means) > high)).sum()
        assert out <= binom.ppf(0.999, steps + 1, 0.05), (out, means)


@pytest.mark.parametrize("lag", [0.0, 0.06])
def test_an_unknown_is_refused_if_it_moves_what_no_sensor_sees(lag: float) -> None:
    """A push on either state, on both or on none, where the second moves the first or not, and one of them is read."""
    for first, second, coupled, read in product([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0, 1]):
        system = linear([[-0.5, coupled], [0.0, -0.3]], [[1.0], [1.0]], [[first], [second]])
        uncertainty = Uncertainty(unknowns=(CONSTANT,), lag=lag, **NOISE)
        options: dict[str, Any] = {"tolerate": 0.5, "effort": 2.0, "sensors": (f"s{read}",)}
        seen = second if read else first or second * coupled
        if (first or second) and not seen:
            with pytest.raises(ls.InputError, match="unknowns: got d0, want one that a measurement sees"):
                ls.OffsetFree(system.problem, system.solution, uncertainty, **options)
        else:
            ls.OffsetFree(system.problem, system.solution, uncertainty, **options)


def test_a_wrong_noise_is_found_out() -> None:
    """The same test sees a filter that believes in half of the noise."""
    trials, steps = 1000, 20
    system = double_integrator(controls=np.zeros((steps, 1)))
    law = law_of(system, 0, measurement=0.05)
    truth = Truth(law, system, trials, np.random.default_rng(0))
    run = law.start(trials)
    for t in range(steps + 1):
        truth.step(run.control(t, truth.measured()))
    assert run.innovations is not None
    nis = np.einsum("tki,tij,tkj->tk", run.innovations, np.linalg.inv(law.filter.innovation), run.innovations).mean(
        axis=1
    )
    assert (nis > chi2.ppf(0.975, 2 * trials) / trials).all()


def test_covariances_stay_positive_without_any_noise() -> None:
    """Sensors without noise make a singular matrix: nothing is less than zero beyond rounding, and nothing is lost."""
    system = linear(np.diag([0.5, -1.0]), [[1.0], [2.0]], [[1.0], [0.0]], controls=np.ones((100, 1)))
    uncertainty = Uncertainty(unknowns=[CONSTANT], start=[1.0, 1e-6], lag=0.05)
    filtered = kalman_filter(PlanModel(PlanDerivatives(system.problem.dynamics, system.plan), uncertainty))
    for covariance in (*filtered.predicted, *filtered.corrected):
        assert np.linalg.eigvalsh(covariance).min() > -1e-14
    # A gentle law: the lag of one that needs it would be taken for less.
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=5.0, effort=2.0, record=True)
    run, x, reached = law.start(1), system.plan.states[0] + [0.7, -1e-6], system.plan.controls[0]
    left = np.exp(-DT / 0.05)
    for t in range(system.plan.steps):
        command = run.control(t, x[None])[0]
        applied = command + (1 - left) * 0.05 / DT * (reached - command)
        reached = command + left * (reached - command)
        x = system.A @ x + system.B @ applied + system.E @ [0.9]
    assert run.estimates is not None
    np.testing.assert_allclose(run.estimates[-2, 0, -1], 0.9, rtol=0, atol=1e-6)


@pytest.mark.parametrize("case", [1, 3])
def test_each_trial_of_a_batch_has_the_bits_that_it_has_alone(case: int) -> None:
    steps = 10
    system = double_integrator(controls=np.ones((steps, 1)), limits=(-3.0, 3.0))
    law = law_of(system, case)
    shown = np.random.default_rng(1).normal(size=(steps, 64, 2))
    shown[4, ::3] = np.nan  # lost

    def bits(chosen: slice) -> tuple[bytes, bytes]:
        run = law.start(len(shown[0, chosen]))
        commands = np.array([run.control(t, shown[t, chosen]) for t in range(steps)])
        assert run.estimates is not None
        return commands.transpose(1, 0, 2).tobytes(), run.estimates[:steps].transpose(1, 0, 2).tobytes()

    whole = bits(slice(0, 64))
    for count in (1, 7):
        parts = [bits(slice(first, first + count)) for first in range(0, 64, count)]
        assert b"".join(part[0] for part in parts) == whole[0]
        assert b"".join(part[1] for part in parts) == whole[1]


def test_so_has_the_quadrotor(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    unknowns = [Unknown(f"wind_{axis}", 1.0) for axis in "xyz"] + [Unknown("mass", 0.02)]
    uncertainty = Uncertainty(unknowns=unknowns, measurement=0.01, start=0.01, lag=0.02)
    law = ls.OffsetFree(
        quadrotor.problem, quadrotor_solution, uncertainty, tolerate={"m": 0.05, "m/s": 0.3, "rad": 0.2, "rad/s": 1.0}
    )
    plan, rng = quadrotor_solution.trajectory, np.random.default_rng(0)
    shown = plan.states[:12, None] + 0.02 * rng.normal(size=(12, 64, 12))

    def bits(chosen: slice) -> bytes:
        run = law.start(len(shown[0, chosen]))
        return np.array([run.control(t, shown[t, chosen]) for t in range(12)]).transpose(1, 0, 2).tobytes()

    whole = bits(slice(0, 64))
    for count in (1, 7):
        assert b"".join(bits(slice(first, first + count)) for first in range(0, 64, count)) == whole


def test_what_is_recorded_has_gaps_where_nothing_came() -> None:
    system = double_integrator(steps=6)
    uncertainty = Uncertainty(unknowns=[CONSTANT], latency=2, **NOISE)  # type: ignore[arg-type]
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, record=True)
    run = law.start(2)
    shown = np.random.default_rng(0).normal(size=(6, 2, 2))
    shown[4, 1] = np.nan
    for t in range(6):
        run.control(t, shown[t])
    assert run.estimates is not None
    assert run.innovations is not None
    assert run.estimates.shape == (7, 2, 3)
    assert run.innovations.shape == (7, 2, 2)
    # Measurements of knots 0 to 3 came, at steps 2 to 5; that of knot 2 got lost on the way to the second trial.
    assert np.isfinite(run.estimates[:4]).all()
    assert np.isnan(run.estimates[4:]).all()
    assert np.isfinite(run.innovations[:4]).all(axis=2).tolist() == [[True] * 2, [True] * 2, [True, False], [True] * 2]
    quiet = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0)
    unrecorded = quiet.start(2)
    assert unrecorded.estimates is None
    assert unrecorded.innovations is None


# Exact, redundant and nearly redundant information. The reference is dense conditioning with 100 digits.

HARD = {
    "exact": ((CONSTANT, PASSING), None),
    "the same twice": ((CONSTANT,), [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
    "nearly the same twice": ((CONSTANT,), [[1.0, 0.5], [1.0, 0.5 + 1e-9]]),
    "two unknowns of one effect": ((CONSTANT, Unknown("offset of u0", 0.3), Unknown("offset of u0", 0.2)), None),
    "two unknowns of nearly one effect": ((CONSTANT, Unknown({"d0": 1.0, "offset of u0": 1e-9}, 0.5)), ("s0",)),
}


def precisely(model: PlanModel, least: Array, t: int) -> tuple[Any, Any]:
    """Covariance of z_t given y_0 .. y_t, and the gain of y_t in its mean: dense, with the noise `least` besides."""
    exact, size, count, n = mpmath.matrix, model.size, model.sensor.size, model.n
    to, source = [mpmath.eye(size)], [exact(model.start_root)]
    for i in range(t):
        to = [exact(model.step.F[i]) * one for one in to] + [mpmath.eye(size)]
        source.append(exact(triangular_root(model.disturbing)[i]))
    # All measured numbers and z_t, as linear functions of the same independent standard normal numbers.
    seen = mpmath.zeros((t + 1) * count, (t + 1) * (size + n + count))
    last = mpmath.zeros(size, seen.cols)
    for j in range(t + 1):
        reached = source[j]
        for i in range(j, t + 1):
            if i > j:
                reached = exact(model.step.F[i - 1]) * reached
            seen[i * count : (i + 1) * count, j * size : (j + 1) * size] = (
                exact(model.derivatives.H[i]) * reached[:n, :]
            )
        last[:, j * size : (j + 1) * size] = reached
        noise = (t + 1) * size + j * (n + count)
        seen[j * count : (j + 1) * count, noise : noise + n] = exact((model.derivatives.H * model.measurement_std)[j])
        seen[j * count : (j + 1) * count, noise + n : noise + n + count] = mpmath.diag(list(least[j]))
    gain = last * seen.T * mpmath.inverse(seen * seen.T)
    return last * last.T - gain * seen * last.T, gain[:, t * count : (t + 1) * count]


@pytest.mark.parametrize("noise", [0.0, 1e-9])
@pytest.mark.parametrize("name", HARD)
def test_exact_and_redundant_sensors_lose_no_digits(name: str, noise: float) -> None:
    """Standard deviations and correlations to 1e-7; gains to 1e-6 of the spread of what they correct."""
    unknowns, sensors = HARD[name]
    system = linear(
        [[0.3, 1.0], [-0.5, -0.2]], [[0.1], [1.0]], [[0.0], [0.7]], controls=np.cos(np.arange(4.0))[:, None]
    )
    uncertainty = Uncertainty(unknowns=unknowns, start=[1.0, 1e-3], lag=0.06, measurement=noise, control=1e-2)
    law = ls.OffsetFree(system.problem, system.solution, uncertainty, tolerate=0.5, effort=2.0, sensors=sensors)
    bare = PlanModel(PlanDerivatives(system.problem.dynamics, system.plan, law.model.sensor), uncertainty)
    for model in (law.model, bare):  # with and without the least errors that OffsetFree assumes
        found, t = kalman_filter(model), model.plan.steps
        seen = model.derivatives.H @ found.predicted[:, : model.n, : model.n] @ model.derivatives.H.transpose(0, 2, 1)
        variance = np.diagonal(seen, axis1=1, axis2=2) + ((model.derivatives.H * model.measurement_std) ** 2).sum(
            axis=2
        )
        with mpmath.workdps(60):
            covariance, gain = (
                np.array(one.tolist(), dtype=np.float64) for one in precisely(model, RESOLUTION * np.sqrt(variance), t)
            )
        std = np.sqrt(covariance.diagonal())
        np.testing.assert_allclose(found.corrected[t] / np.outer(std, std), covariance / np.outer(std, std), atol=1e-7)
        wrong = found.gain[t] - gain
        spread = np.sqrt(np.einsum("zi,ij,zj->z", wrong, found.innovation[t], wrong))
        assert (spread <= 1e-6 * np.sqrt(found.predicted[t].diagonal())).all()
