"""Real signals to real commands, at many moments, and streams that are full, closed or read by nobody."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sampling import rarely

import lqrsim as ls
from lqrsim.view import gl

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals to other processes are POSIX's")

STOPPED = "lqrsim: stopped\n"
COMMAND = [sys.executable, "-m", "lqrsim.cli"]
PICTURE = """
import sys, time
from pathlib import Path
from lqrsim.results.archive import replacing
with replacing(Path(sys.argv[sys.argv.index("--out") + 1]) / "figures" / "a.png") as unfinished:
    unfinished.write_bytes(b"half")
    time.sleep(60)
"""
TALKATIVE = """
import sys
from lqrsim import cli
from lqrsim.commands import console
console.LINE_EVERY = 0.0  # says at every frame how far it is
sys.exit(cli.main())
"""
REPRODUCE = """
import pathlib, sys
from lqrsim import cli
from lqrsim.commands import reproduce
reproduce.EXPERIMENTS = pathlib.Path(sys.argv.pop(1))
sys.exit(cli.main())
"""


def start(*command: str | Path, **options: object) -> subprocess.Popen[str]:
    """In a group of its own, and with the threads that NumPy starts by default: signals may come to any of them."""
    words = [str(word) for word in command]
    outside = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen(words, **(pipes | {"env": outside} | options))  # pyright: ignore[reportArgumentType, reportCallIssue]


def wait_for(found: Path, pattern: str, process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + 600
    while not list(found.glob(pattern)):
        assert time.monotonic() < until
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("module", "number"),
    [
        ("tyro", signal.SIGINT), ("mujoco", signal.SIGTERM),
        *rarely(
            ("tyro", signal.SIGTERM), ("mujoco", signal.SIGINT), ("numpy", signal.SIGINT),
            ("lqrsim.problem.parts", signal.SIGTERM),
        ),
    ],
)  # fmt: skip
def test_a_signal_while_it_starts_is_one_line(module: str, number: int) -> None:
    """As soon as it says that a module has been imported. A run that was over before the signal came is made again."""
    code, error = 0, ""
    for _ in range(20):
        with start(sys.executable, "-X", "importtime", *COMMAND[1:], "list") as process:
            assert process.stderr is not None
            for line in process.stderr:
                if line.split("|")[-1].strip() == module:
                    break
            else:
                pytest.fail(f"{module} was not imported")
            process.send_signal(number)
            error = "".join(line for line in process.stderr if not line.startswith("import time:"))
        code = process.returncode
        if code or error:
            break
    assert (code, error) == (128 + number, STOPPED)


WITHIN = """
import os, signal, sys
from lqrsim.cli import main

module, number = sys.argv.pop(1), int(sys.argv.pop(1))


def told(event, about):
    if event == "import" and about[0] == module:
        os.kill(os.getpid(), number)


sys.addaudithook(told)
sys.exit(main())
"""


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize(
    ("module", "number"),
    [
        ("mujoco._enums", signal.SIGTERM),
        *rarely(
            ("mujoco._structs", signal.SIGINT), ("mujoco._specs", signal.SIGTERM), ("mujoco.glfw", signal.SIGINT),
            ("numpy", signal.SIGTERM),
        ),
    ],
)  # fmt: skip
def test_a_signal_while_a_command_imports_is_one_line(module: str, number: int, tmp_path: Path) -> None:
    """MuJoCo's modules import each other from C++, which makes an ImportError of the interrupt."""
    command = ["solve", "quadrotor", "--out", tmp_path]
    with start(sys.executable, "-c", WITHIN, module, str(int(number)), *command) as process:
        _, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (128 + number, STOPPED)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    rollout = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[ls.disturbances.ForceNoise(0.1)])
    return ls.save(rollout, folder / "rollout.npz")


@pytest.mark.parametrize(
    ("suffix", "number"),
    [
        ("mp4", signal.SIGTERM), ("gif", signal.SIGHUP),
        *rarely(("gif", signal.SIGTERM), ("mp4", signal.SIGINT), ("gif", signal.SIGINT), ("mp4", signal.SIGHUP)),
    ],
)  # fmt: skip
def test_a_signal_while_it_films_leaves_nothing(flown: Path, number: int, suffix: str, tmp_path: Path) -> None:
    if gl.missing():
        pytest.skip("no OpenGL here")
    out = tmp_path / f"a.{suffix}"
    with start(
        *COMMAND, "render", flown, "--out", out, "--fps", "50", "--speed", "0.2", "--size", "1280", "720"
    ) as process:
        wait_for(tmp_path, ".unfinished-*", process)
        time.sleep(random.Random(f"{number} {suffix}").uniform(0, 1))
        process.send_signal(number)
        time.sleep(0.05)
        process.send_signal(number)  # whoever is impatient does not keep it from tidying up
        _, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (128 + number, STOPPED)
    assert list(tmp_path.iterdir()) == []


AGAIN = """
import os, signal, sys, time
from lqrsim import process

process.handle_signals("stopped")
write = os.write


def interrupted(descriptor, text):
    written = write(descriptor, text)
    if descriptor == 2:
        os.kill(os.getpid(), signal.SIGTERM)
    return written


os.write = interrupted
os.kill(os.getpid(), signal.SIGINT)
time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_the_last_words_are_said_once() -> None:
    """Though a second signal comes while they are said."""
    done = subprocess.run([sys.executable, "-c", AGAIN], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "stopped\n")


LATE = """
import hashlib, os, signal, time
from lqrsim import process

process.handle_signals("stopped")
process.GRACE, rounds, took = 0.3, 100_000, 0.0
while took < 2 * process.GRACE:  # compiled code for longer than a second signal is ignored
    rounds, began = 2 * rounds, time.monotonic()
    hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)
    took = time.monotonic() - began
try:
    with process.interruptible():
        try:
            print("ready", flush=True)
            time.sleep(60)
        finally:
            print("tidying", flush=True)
            hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)
            print("tidied", flush=True)
except KeyboardInterrupt:
    process.end_stopped()
"""


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_second_signal_at_once_is_ignored_however_late_it_is_handled() -> None:
    """While compiled code tidies up, Python handles no signal; what counts is when it came."""
    with start(sys.executable, "-c", LATE) as process:
        assert process.stdout is not None
        for line in ("ready\n", "tidying\n"):
            assert process.stdout.readline() == line
            process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=600)
    assert (process.returncode, out, error) == (130, "tidied\n", "stopped\n")


@pytest.mark.parametrize(
    ("number", "everyone"), [(signal.SIGINT, True), (signal.SIGTERM, False), *rarely((signal.SIGINT, False))]
)
def test_a_signal_while_it_reproduces_leaves_nothing(number: int, everyone: bool, tmp_path: Path) -> None:
    """To the whole group, as Ctrl-C in a terminal, or to the command alone."""
    folder, out = tmp_path / "experiments", tmp_path / "out"
    folder.mkdir()
    (folder / "table_1.py").write_text(PICTURE)
    with start(sys.executable, "-c", REPRODUCE, folder, "reproduce", "table_1", "--out", out) as process:
        wait_for(tmp_path, "out/figures/.unfinished-*", process)
        (os.killpg if everyone else os.kill)(process.pid, number)
        _, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (128 + number, STOPPED)
    assert [path for path in out.rglob("*") if path.is_file()] == []
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_no_worker_can_be_interrupted_while_it_starts(tmp_path: Path) -> None:
    """Neither the first, with which Python starts another process, nor the second: the kernel holds SIGINT back."""
    code = tmp_path / "start.py"
    code.write_text(
        "import time\nfrom pathlib import Path\nfrom lqrsim.stress import campaign\n"
        "if __name__ == '__main__':\n"
        "    for _ in range(2):\n"
        "        process = campaign._context.Process(target=time.sleep, args=(60,))\n"
        "        with campaign._without_ctrl_c():\n"
        "            process.start()\n"
        "        status = Path(f'/proc/{process.pid}/status').read_text()\n"
        "        blocked = next(line for line in status.splitlines() if line.startswith('SigBlk'))\n"
        "        print(bool(int(blocked.split()[1], 16) & 2))\n"
        "        process.kill()\n"
    )
    done = subprocess.run([sys.executable, code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.skipif(sys.platform != "linux", reason="where MuJoCo comes with GLFW, which starts a process to be found")
def test_a_worker_starts_no_other_process(tmp_path: Path) -> None:
    """It would go on when the worker is killed, and complain that nobody reads what it says."""
    code = tmp_path / "start.py"
    code.write_text(
        "import sys\n"
        "if __name__ == '__mp_main__':\n"
        "    sys.addaudithook(lambda event, _: print(event, flush=True) if event == 'subprocess.Popen' else None)\n"
        "import mujoco\nfrom lqrsim.stress import campaign\n"
        "def work():\n"
        "    print('glfw.library' in sys.modules)\n"
        "if __name__ == '__main__':\n"
        "    process = campaign._context.Process(target=work)\n"
        "    with campaign._worker_environment():\n"
        "        process.start()\n"
        "    process.join()\n"
    )
    surroundings = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYGLFW_LIBRARY")}
    done = subprocess.run([sys.executable, code], capture_output=True, text=True, check=True, env=surroundings)
    assert done.stdout.split() == ["True"]


INTERRUPTED = """
import multiprocessing, sys
from lqrsim.stress import campaign
from lqrsim.stress.study import Shard

class Job(campaign.Job):
    def prepare(self, **_):
        pass
    def work(self, shard, runner):
        return b""

def interrupt(number):
    returned = 0
    def count(frame, event, arg):
        nonlocal returned
        returned += event == "return"
        if returned == number:
            sys.setprofile(None)
            raise KeyboardInterrupt
    return count

if __name__ == "__main__":
    for number in map(int, sys.argv[1:]):
        run = campaign.run_in_processes(Job({}, {}, 1), [Shard(0, i, 1) for i in range(40)], 2, 100.0)
        sys.setprofile(interrupt(number))
        try:
            list(run)
        except KeyboardInterrupt:
            print(number)
        sys.setprofile(None)
        for worker in multiprocessing.active_children():
            worker.join()
"""


@pytest.mark.parametrize("seed", [0, *rarely(*range(1, 10))])
def test_workers_end_wherever_ctrl_c_comes(seed: int, tmp_path: Path) -> None:
    """At the end of any function of Python's or ours, also where it has just locked something."""
    (tmp_path / "run.py").write_text(INTERRUPTED)
    numbers = [str(random.Random(seed).randrange(1, 400)) for _ in range(12)]
    asked = [sys.executable, tmp_path / "run.py", *numbers]
    done = subprocess.run(asked, capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout.split() == numbers


@pytest.mark.parametrize("ready", ["manifest.json", pytest.param("shards/*.parquet", marks=pytest.mark.long)])
def test_ctrl_c_in_a_stress_test_says_how_to_go_on(ready: str, tmp_path: Path) -> None:
    """To all processes at once, as a terminal does: while workers start, and while they work."""
    asked = "--policies smooth --trials 2000 --shard 20 --strengths 1 --workers 2 --out"
    with start(*COMMAND, "stress", "quadrotor", *asked.split(), tmp_path / "run") as process:
        wait_for(tmp_path / "run", ready, process)
        time.sleep(random.Random(ready).uniform(0, 0.5))
        os.killpg(process.pid, signal.SIGINT)
        _, error = process.communicate(timeout=600)
    *_, note, end = error.splitlines(keepends=True)  # a slow solve says before how far it is
    assert (process.returncode, end) == (130, STOPPED)
    assert f"lqrsim stress quadrotor --resume --out {tmp_path / 'run'}" in note
    assert not list((tmp_path / "run").rglob(".unfinished-*"))


HELP = ["solve --help", "--version", *rarely("--help", "list", "cache")]


@pytest.mark.parametrize("command", HELP)
def test_nobody_reads_it(command: str) -> None:
    """The pipe is closed before anything is written."""
    with start(*COMMAND, *command.split()) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
@pytest.mark.parametrize("command", HELP)
def test_a_full_device_is_one_line(command: str) -> None:
    with open("/dev/full", "w") as full, start(*COMMAND, *command.split(), stdout=full) as process:
        _, error = process.communicate(timeout=600)
    says = "lqrsim: error: standard output: got No space left on device, want one that can be written\n"
    assert (process.returncode, error) == (2, says)


@pytest.mark.parametrize("command", HELP)
def test_closed_streams_are_no_error(command: str, tmp_path: Path) -> None:
    """And the first file that is opened does not take their place."""
    line = f'exec "$0" -m lqrsim.cli {command} <&- >&- 2>"$1"'
    told = tmp_path / "told"
    done = subprocess.run(["sh", "-c", line, sys.executable, told], check=False)
    assert (done.returncode, told.read_text()) == (0, "")


def test_what_is_printed_while_a_file_is_written(flown: Path, tmp_path: Path) -> None:
    """That nobody reads it is no error of the file."""
    if gl.missing():
        pytest.skip("no OpenGL here")
    options = ["--out", tmp_path / "a.mp4", "--fps", "20", "--size", "320", "180"]
    with start(sys.executable, "-c", TALKATIVE, "render", flown, *options) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141
    assert list(tmp_path.iterdir()) == []
