"""Whether a campaign that is killed again and again gives the same bits: `lqrsim stress`, SIGKILL, the same command.

    python tests/tools/benchmark_campaign.py            # 20 kills
    python tests/tools/benchmark_campaign.py --quick    # 3

Exits with 1 if a table differs from those of a campaign that was left alone, or a row is missing or there twice.
"""

import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from lqrsim.stress.results import Results

sys.path.append(str(Path(__file__).parents[2] / "experiments"))  # has the runner

from runner import Result, Settings, at_most, opening, progress, run

WANTED = ("every trial once", "tables identical to the bit")


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    kills: int = 20
    """How often the driver is killed."""
    trials: int = 1000
    """Of each of two policies."""
    seed: int = 0
    """Of the moments at which it is killed."""


def main(config: Config) -> Result:
    config = at_most(config, kills=3)
    draws = random.Random(config.seed)
    command = [sys.executable, "-m", "lqrsim.cli", "stress", "quadrotor", "--policies", "smooth", "open_loop"]
    command += ["--sweep", "scenario", "--strengths", "1", "--trials", str(config.trials)]
    command += ["--shard", str(max(1, config.trials // 25)), "--out"]
    with tempfile.TemporaryDirectory() as temporary:
        alone, killed = Path(temporary) / "alone", Path(temporary) / "killed"
        begun = time.monotonic()
        finish([*command, str(alone)])
        seconds = time.monotonic() - begun
        there = []
        for _ in progress(range(config.kills), "killing the driver"):
            # Anywhere between the start of the program and its end, so that it also hits the solving and the writing.
            with subprocess.Popen(
                [*command, str(killed)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            ) as driver:
                time.sleep(draws.uniform(0, 0.7 * seconds))
                driver.kill()
            there.append(len(list(killed.glob("shards/*.parquet"))))
        finish([*command, str(killed)])
        same = tables(alone) == tables(killed)
        rows = [sorted(Results(killed).outcomes(cell).trial.tolist()) for cell in Results(killed).cells]
    whole = all(row == list(range(config.trials)) for row in rows)
    return opening(config) | {"shards": there, "every trial once": whole, "tables identical to the bit": same}


def report(result: Result) -> str:
    there = result["shards"]
    shards = f"shards that were there after each of {len(there)} kills, of {2 * 25}: {' '.join(map(str, there))}"
    return "\n".join([shards, *(f"{what}: {'yes' if result[what] else 'NO'}" for what in WANTED)])


def failures(result: Result) -> list[str]:
    return [what for what in WANTED if not result[what]]


def finish(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def tables(folder: Path) -> dict[str, bytes]:
    """The files, which are the same where the tables are."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("shards/*"))}


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=failures)
