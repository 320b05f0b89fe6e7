"""What people install works: the built wheel, in an environment that holds it and its dependencies alone."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import try_release

from lqrsim import machine
from lqrsim.cli import main

ROOT = Path(__file__).parent.parent


def run(*command: object, cwd: Path) -> str:
    done = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that was built from that sdist and so proves it whole."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    return folder


def test_wheel_holds_the_package_the_models_and_the_experiments(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    inside = set(zipfile.ZipFile(wheel).namelist())
    code = [path for ending in ("*.py", "*.j2", "*.html") for path in (ROOT / "lqrsim").rglob(ending)]
    sources = {path.relative_to(ROOT).as_posix() for path in code}
    models = {f"lqrsim/models/{path.name}" for path in (ROOT / "models").glob("*.xml")}
    scripts = {f"lqrsim/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "experiments").rglob("*.py")}
    assert models
    assert scripts
    assert sources | models | scripts | {"lqrsim/py.typed"} <= inside
    assert {name.split("/")[0] for name in inside} == {"lqrsim", f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"}


def test_sdist_is_complete(built: Path) -> None:
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "CITATION.cff",
        "pyproject.toml",
        "run.py",
        "tests/test_packaging.py",
    } <= inside


# Optional packages as if they were not installed: neither modules nor metadata.
WITHOUT = """
import importlib.metadata, sys

OPTIONAL = ("casadi", "crocoddyl", "distributed", "gymnasium", "jax", "numba", "rerun")
found = importlib.metadata.Distribution.from_name.__func__


def from_name(cls, name):
    if name.partition("-")[0] in OPTIONAL:
        raise importlib.metadata.PackageNotFoundError(name)
    return found(cls, name)


importlib.metadata.Distribution.from_name = classmethod(from_name)
sys.modules.update(dict.fromkeys(OPTIONAL))
import lqrsim as ls

problem = ls.scenarios.differential_drive().problem
solution = ls.smooth(problem, starts=1)
assert solution.success, solution
ls.save(solution, "solution.npz")
assert ls.load("solution.npz", ls.Solution).cost == solution.cost
"""


@pytest.mark.long
def test_solves_without_optional_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From formulas to a file, with nothing cached; some 5 s."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run(sys.executable, "-c", WITHOUT, cwd=tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("python", try_release.pythons())
def test_wheel_works_in_an_empty_environment(python: str, built: Path, tmp_path: Path) -> None:
    """Installs for real, with the dependencies that the wheel names and no others, and runs without a network."""
    (wheel,) = built.glob("*.whl")
    programs = try_release.installed(try_release.pythons()[python], wheel, tmp_path / "empty")
    try_release.works(programs, wheel.name.split("-")[1], tmp_path, quick=True)


@pytest.mark.parametrize("name", ["numpy", "mujoco", "scipy", "llvmlite", "tyro"])
def test_a_package_that_is_too_old_is_named(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where another package has brought it: by every command, and at import; a newer one is not."""
    needs = dict(re.findall(r'"([\w.-]+)>=([\d.]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    found = machine.versions_of(*needs)
    least = [int(part) for part in needs[name].split(".")]
    older = [f"{least[0] - 1}.99.4", ".".join(map(str, [*least[:-1], least[-1] - 1])), "0.0.dev3"]
    newer = [needs[name], f"{needs[name]}.0rc1", f"{least[0]}.{least[1] + 10}", f"{least[0] + 1}"]
    for version in [one for one in older if "-1" not in one] + newer:
        monkeypatch.setattr(
            machine, "versions_of", lambda *names, one=version: {n: one if n == name else found[n] for n in names}
        )
        machine.outdated.cache_clear()
        line = f"got {name} {version}, want newer: pip install '{name}>={needs[name]}'"
        assert machine.outdated() == ("" if version in newer else line)
        assert main(["list"]) == (0 if version in newer else 2)
        assert capsys.readouterr().err == ("" if version in newer else f"lqrsim: error: {line}\n")
    machine.outdated.cache_clear()


def test_citation_is_of_this_version_and_has_the_fields_of_its_format() -> None:
    """https://citation-file-format.github.io, version 1.2.0: the required keys, and what a reference needs."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    keys = set(re.findall(r"^([a-z-]+):", citation, re.MULTILINE))
    assert {"cff-version", "message", "title", "authors"} <= keys
    assert keys <= {"cff-version", "message", "type", "title", "abstract", "authors", "version", "license", "keywords",
                    "references"}  # fmt: skip
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"\nversion: {project['version']}\n" in citation
    assert f"\nlicense: {project['license']}\n" in citation
    assert {"type", "title", "authors"} <= set(re.findall(r"^  [- ] ([a-z-]+):", citation, re.MULTILINE))
