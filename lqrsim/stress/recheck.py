"""Checking a certificate: the measurement of `RareFailures.certificate` again, as `lqrsim certify`."""

from dataclasses import dataclass, fields
from typing import Annotated, Any

from lqrsim.annotations import Bounds, Seed, TextProgress, checked
from lqrsim.errors import InputError
from lqrsim.results.certificate import FailureCertificate
from lqrsim.scenarios.references import names_code
from lqrsim.stress.failure_search import RareFailures, ReliabilityProblem, Report
from lqrsim.stress.multilevel_splitting import MOST
from lqrsim.versions import changed


@dataclass(frozen=True, eq=False)
class Recheck:
    """The repeated measurement of a certificate.

    Attributes:
      measured: the RareFailures with the same seed.
      differences: a line for each difference of the two; empty if there is none.
      changed: the reason why the bits may differ, so that only the intervals were compared: another seed, or changed
        versions; else empty.
    """

    certificate: FailureCertificate
    measured: RareFailures
    differences: tuple[str, ...]
    changed: str

    def summary(self) -> str:
        """Lines that describe the repeated measurement and the comparison."""
        done, asked = len(self.measured.splitting.repetitions), len(self.certificate.repetitions)
        lines = [f"measured again: {done} of {asked} repetitions, {self.measured.splitting.simulations:,} trials"]
        if self.changed:
            lines.append(
                f"{self.measured.probability:.2g}; intervals are compared, for the bits may differ: got {self.changed}"
            )
        lines += [f"NOT as certified: {one}" for one in self.differences]
        if not self.differences:
            lines.append("as certified: the intervals overlap" if self.changed else "as certified, to the last bit")
        return "\n".join(lines)

    __str__ = summary


@checked
def certify(
    certificate: FailureCertificate,
    *,
    repetitions: Annotated[int, Bounds(at_least=2, at_most=MOST)] | None = None,
    seed: Seed | None = None,
    scenario: str | None = None,
    report: Report | None = None,
    progress: TextProgress | None = None,
) -> Recheck:
    """Repeat the measurement of a certificate, in whole or in part.

    Args:
      certificate: from `RareFailures.certificate`, or `ls.load`.
      repetitions: number of its repetitions to run, at least 2; by default all.
      seed: another seed, for fresh random numbers: then intervals are compared. By default the certificate's.
      scenario: reference to the scenario if it is your own function: files never choose code to run.

    Raises:
      NoFailure: no failure was found.
    """
    every = len(certificate.repetitions)
    count = every if repetitions is None else repetitions
    if count > every:
        raise InputError(f"repetitions: got {count}, want at most the certificate's {every}")
    if scenario is None and names_code(certificate.scenario):
        raise InputError(f"scenario: got none, want the certificate's scenario, {certificate.scenario}, which is code")
    stated: dict[str, Any] = {one.name: getattr(certificate, one.name) for one in fields(ReliabilityProblem)}
    if scenario is not None:
        stated["scenario"] = scenario
    problem = ReliabilityProblem(**stated)
    now = problem.facts
    differences = [
        f"{name}: got {value}, want {was}"
        for name, value in now.items()
        if value != (was := getattr(certificate, name))
    ]
    measured = problem.rare_failures(
        particles=certificate.particles, repetitions=count, keep=certificate.keep, seed=seed, report=report,
        progress=progress,
    )  # fmt: skip
    fresh = f"seed {seed} (was {certificate.seed})" if seed not in (None, certificate.seed) else ""
    others, one = fresh or changed(certificate.versions), measured.probability
    if others:
        if one.low > certificate.high or certificate.low > one.high:
            differences.append(f"probability: got {one:.2g}, want an interval that overlaps")
    else:
        pairs = zip(measured.splitting.repetitions.tolist(), certificate.repetitions.tolist(), strict=False)
        differences += [
            f"repetition {i}: got {got!r}, want {want!r}" for i, (got, want) in enumerate(pairs) if got != want
        ]
        ends = (one.value, one.low, one.high), (certificate.probability, certificate.low, certificate.high)
        if count == every and ends[0] != ends[1]:
            differences.append(f"probability with its interval: got {ends[0]}, want {ends[1]}")
    return Recheck(certificate, measured, tuple(differences), others)
