"""The thousand random problems: how they end, and whether iLQR finds anything left to improve."""

from typing import Any

from reliability.common import Config, converged, endings, improvements, mean, solve, summary, worst
from reliability.problems import thousand


def measure(config: Config) -> dict[str, Any]:
    drawn = list(thousand(config.seed, share=config.share, kinds=config.kinds))
    solutions = solve(config, [problem for _, problem in drawn], "random")
    found: dict[str, Any] = {}
    for kind in config.kinds:
        pairs = [(problem, solution) for (of, problem), solution in zip(drawn, solutions, strict=True) if of == kind]
        found[kind] = summary([solution for _, solution in pairs]) | {
            "improvement": improvements(pairs[: config.sample], f"random, improving {kind}")
        }
    return found


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"random: {'':<10} {'converged':>11} {'iterations':>11} {'damped':>7} {'handed over':>12}"
        f" {'optimality at worst':>20} {'gap':>8} {'iLQR improves at worst':>23}"
    ]
    for kind, one in found.items():
        done = [i for i, status in enumerate(one["status"]) if status == "CONVERGED"]
        count, tried = len(one["status"]), [value for value in one["improvement"] if value is not None]
        rows.append(
            f"  {kind:<16} {converged(one):>7}/{count:<3} {mean(one['iterations'][i] for i in done):>11.1f}"
            f" {sum(one['damped']):>7} {sum(one['handed_over']):>12} {worst(one['optimality'][i] for i in done):>20.1e}"
            f" {worst(one['gap'][i] for i in done):>8.1e} {100 * worst(tried):>14.4f} % of {len(tried):<3}"
            f"  {endings(one)}".rstrip()
        )
    total = sum(len(one["status"]) for one in found.values())
    solved = sum(converged(one) for one in found.values())
    handed = sum(sum(one["handed_over"]) for one in found.values())
    rows.append(f"  {solved} of {total} converged, {handed} were handed over to iLQR")
    return ["\n".join(rows)]
