"""What each part contributes: the form, the start, the prior, the safeguard; all that there is of them."""

from itertools import product
from typing import Any

from runner import progress

from reliability.common import Config, cost_from_start, endings, mean, paper_start, queries, solve, summary

PARTS = (("dual", "primal"), ("soft", "fixed"), ("prior", "no prior"), ("safeguard", "bare"))


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for form, start, prior, safeguard in product(*PARTS):
        name = ", ".join((form, start, prior, safeguard))
        if (form, start) == ("primal", "fixed"):
            found[name] = {"skipped": "the primal form has no fixed start: its cost-to-come would be infinite"}
            continue
        problems = queries(config, soft=start == "soft")
        options: dict[str, Any] = {"form": form, "safeguard": safeguard == "safeguard"}
        options["start"] = paper_start() if prior == "prior" else problems[0].nominal_control
        solutions = solve(config, problems, f"ablation, {name}", **options)
        pairs = progress(list(zip(problems, solutions, strict=True)), f"ablation, costs of {name}")
        found[name] = summary(solutions) | {"cost_from_start": [cost_from_start(*pair) for pair in pairs]}
    return found


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"ablation: {'':<35} {'failed':>7} {'handed over':>12} {'iterations':>11} {'cost':>8} {'from the start':>15}"
        "   (means of those that converged)"
    ]
    for name, one in found.items():
        if "skipped" in one:
            if name.endswith("prior, safeguard") and "no prior" not in name:  # once is enough
                rows.append(f"  {'primal, fixed':<43} {one['skipped']}")
            continue
        done = [i for i, status in enumerate(one["status"]) if status == "CONVERGED"]
        failed = len(one["status"]) - len(done)
        rows.append(
            f"  {name:<43} {failed:>7} {sum(one['handed_over']):>12} {mean(one['iterations'][i] for i in done):>11.2f}"
            f" {mean(one['cost'][i] for i in done):>8.2f} {mean(one['cost_from_start'][i] for i in done):>15.2f}"
            f"  {endings(one)}".rstrip()
        )
    return ["\n".join(rows)]
