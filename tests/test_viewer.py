"""Viewers: nobody but this machine reaches them, they show what was run, and whoever sits before them can interfere."""

import contextlib
import itertools
import os
import re
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import browsing
import mujoco
import numpy as np
import pytest
from sampling import rarely
from viewers import Recorder, said, said_after, viewing
from websockets import Origin
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import lqrsim as ls
from lqrsim.cli import main
from lqrsim.commands.viewing import View
from lqrsim.errors import InputError
from lqrsim.results import save_load
from lqrsim.simulation.disturbances import ForceNoise
from lqrsim.view import viewer
from lqrsim.view.browser import Browser
from lqrsim.view.viewer import PUSHES

PORT = 18650 + os.getpid() % 1000  # of our own, also where tests run side by side


@pytest.fixture(scope="module")
def rollout(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> ls.Rollout:
    return ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=[ForceNoise(0.1)], seed=1)


@pytest.fixture(scope="module")
def served(rollout: ls.Rollout, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A run is played; the port."""
    folder, port = tmp_path_factory.mktemp("served"), PORT
    save_load.save(rollout, folder / "run.npz")
    with viewing(folder, "run.npz", "--port", str(port)) as process:
        text = said(process, "Ctrl-C ends it")
        assert f"http://localhost:{port}/" in text
        assert f"ssh -L {port}:127.0.0.1:{port}" in text
        assert refused("::1", port)
        yield port
    assert process.returncode == 0
    assert refused("127.0.0.1", port)
    assert sorted(path.name for path in folder.iterdir() if path.name != ".mujoco.ini") == ["run.npz"]


def refused(address: str, port: int) -> bool:
    try:
        socket.create_connection((address, port), timeout=5).close()
    except OSError:
        return True
    return False


def listening(port: int) -> list[str]:
    """Addresses, in the kernel's own words, at which this machine listens to a port."""
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    places = [row[1].split(":") for row in rows if row[3] == "0A"]
    return [address for address, number in places if int(number, 16) == port]


BIND = """from mujoco.studio.web import web_server
bind = web_server.bind_public_socket
web_server.bind_public_socket = lambda host, port=0: bind({}, port)"""
SERVE = """from mujoco.studio.web import web_server
def shared(process):
    def answer(connection, request, response):
        response = process(connection, request, response) or response
        response.headers["Access-Control-Allow-Origin"] = "*"
        return response
    return answer
serve = web_server.serve
web_server.serve = lambda handler, **options: serve(handler, **{{**options, {}}})"""


@pytest.mark.parametrize(
    ("before", "reason"),
    [
        (BIND.format("'0.0.0.0'"), r"others can reach the server at \S+, port \d+"),
        *rarely(
            (BIND.format("'::'"), r"others can reach the server at \S+, port \d+"),
            (SERVE.format("'process_request': None"), r"admits http://127\.0\.0\.1:\d+ to /drop, port \d+"),
            (
                SERVE.format("'process_response': shared(options['process_response'])"),
                r"lets any page read /, port \d+",
            ),
        ),
    ],
)
def test_a_server_that_is_not_private_is_refused(rollout: ls.Rollout, before: str, reason: str, tmp_path: Path) -> None:
    """MuJoCo's server is not what it is expected to be: what listens then is found out, and closed."""
    save_load.save(rollout, tmp_path / "run.npz")
    with viewing(tmp_path, "run.npz", "--port", str(PORT + 1), before=before) as process:
        assert re.search(f"{reason}; it was closed", said(process, "lqrsim: error"))
        assert process.wait(600) == 2
    assert refused("127.0.0.1", PORT + 1)


def test_a_server_that_is_not_known_is_refused(rollout: ls.Rollout, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mujoco, "__version__", "4.1.0")
    with pytest.raises(InputError, match=r"got MuJoCo 4\.1\.0, want 4\.0\.x"):
        Browser(port=PORT, **viewer.arguments_for_rollout(rollout, 0))


def test_what_can_not_be_shown(rollout: ls.Rollout, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(save_load.save(rollout, tmp_path / "run.npz"))
    asked = (
        ([path, "--trial", "1"], "trial"),
        ([path, "--speed", "0"], "--speed"),
        (["nowhere.npz"], "nowhere.npz"),
        (["hexapod"], "hexapod"),
    )
    for arguments, reason in asked:
        assert main(["view", *arguments]) == 2
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize("ending", [".npz", ".NPZ", ".Npz"])
def test_a_run_is_known_by_its_ending(
    ending: str, rollout: ls.Rollout, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save_load.save(rollout, tmp_path / "run.npz").rename(tmp_path / f"run{ending}")
    assert main(["view", str(path), "--trial", "1"]) == 2
    assert capsys.readouterr().err.startswith("lqrsim: error: trial: got 1")


FREE = """import dataclasses
import lqrsim as ls

def drive():
    made = ls.scenarios.differential_drive()
    return dataclasses.replace(made, problem=dataclasses.replace(made.problem, duration=(1.0, 60.0), time_weight=1.0))
"""


def test_the_rates_of_replanning_are_those_of_the_duration_found(
    differential_drive: ls.Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """From one plan in it to one in each of its control periods, whatever was guessed of it."""
    monkeypatch.chdir(tmp_path)
    Path("free.py").write_text(FREE, encoding="utf-8")
    assert main(["solve", "free.py:drive", "--out", "."]) == 0
    plan = ls.load("solution.npz", ls.Solution).trajectory
    assert abs(plan.dt - differential_drive.problem.dt) > 0.01 * plan.dt
    monkeypatch.setattr(View, "_planning", lambda *_: sys.exit("planned"))
    for rate, good in ((1 / plan.dt, 1), (1.01 / plan.dt, 0), (1 / plan.horizon, 1), (0.99 / plan.horizon, 0)):
        capsys.readouterr()
        with pytest.raises(SystemExit, match="planned") if good else contextlib.nullcontext():
            assert main(["view", "free.py:drive", "--solution", "solution.npz", "--replan", repr(rate)]) == 2
        assert ("--replan: got" in capsys.readouterr().err) == (not good)


@pytest.mark.skipif(sys.platform != "linux", reason="where windows are opened is said by DISPLAY")
def test_a_display_that_is_gone(
    rollout: ls.Rollout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo's window would be waited for without end."""
    monkeypatch.setenv("DISPLAY", ":64321")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", str(save_load.save(rollout, tmp_path / "run.npz"))]) == 2
    assert "--viewer browser" in capsys.readouterr().err


def test_a_port_that_is_taken(rollout: ls.Rollout, tmp_path: Path) -> None:
    save_load.save(rollout, tmp_path / "run.npz")
    taken = socket.create_server(("127.0.0.1", PORT + 2))
    with taken, viewing(tmp_path, "run.npz", "--port", str(PORT + 2)) as process:
        assert "--port" in said(process, "already in use")
        assert process.wait(600) == 2


def test_a_run_is_shown_as_it_was(rollout: ls.Rollout) -> None:
    count = rollout.frames.shape[1]
    screen = Recorder(2 * count + 5, **viewer.arguments_for_rollout(rollout, 0))
    viewer.play(rollout, screen)
    np.testing.assert_array_equal(screen.shown, [*rollout.frames[0], *rollout.frames[0], *rollout.frames[0][:5]])


def test_a_run_takes_its_time(rollout: ls.Rollout, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 5 times the real speed, 5 seconds take one, on a clock that only sleeping moves."""
    slept: list[float] = []
    clock = SimpleNamespace(
        perf_counter=lambda: sum(slept), monotonic=lambda: sum(slept), sleep=lambda seconds: slept.append(seconds)
    )
    monkeypatch.setattr(viewer, "clock", clock)
    screen = Recorder(rollout.frames.shape[1], **viewer.arguments_for_rollout(rollout, 0))
    screen.speed = 5.0
    viewer.play(rollout, screen)
    assert sum(slept) == pytest.approx(rollout.frame_times[-1] / 5, abs=0.02)


def live(scenario: ls.Scenario, solution: ls.Solution, screen: Recorder, **options: object) -> list[str]:
    lines: list[str] = []
    viewer.live(scenario.plant(), solution, screen, report=lines.append, **options)  # pyright: ignore[reportArgumentType]
    return lines


def test_a_live_run_is_what_simulate_does(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Run k has the numbers of trial k, to the last bit."""
    noise = [ForceNoise(0.1)]
    wanted = ls.simulate(quadrotor.plant(), quadrotor_solution, disturbances=noise, seed=3, trials=2)
    screen = Recorder(300, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    lines = live(quadrotor, quadrotor_solution, screen, disturbances=noise, seed=3)
    np.testing.assert_array_equal(screen.shown, [*wanted.frames[0][1:], *wanted.frames[1][1:]])
    assert [line.split(",")[0] for line in lines] == ["run 0: reached", "run 1: reached"]


def test_a_live_run_takes_a_controller(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    tolerate = {"m": 0.05, "m/s": 0.2, "rad": 0.2, "rad/s": 0.2}
    law = ls.track(quadrotor.problem, quadrotor_solution, tolerate=tolerate)
    noise, plant = [ForceNoise(0.1)], quadrotor.plant()
    wanted = ls.simulate(plant, quadrotor_solution, controller=law, disturbances=noise, seed=3)
    screen = Recorder(150, **viewer.arguments_for_plant(plant, quadrotor_solution))
    live(quadrotor, quadrotor_solution, screen, controller=law, disturbances=noise, seed=3)
    np.testing.assert_array_equal(screen.shown, wanted.frames[0][1:])


@pytest.mark.parametrize("key", PUSHES)
def test_a_push_is_felt_and_overcome(key: str, quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """0.3 m/s at 3 s: a decimetre off, in the direction of the key, and back within 3 cm at the end, at 5 s."""
    screen = Recorder(150, push=0.3, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    azimuth = 0.0
    screen.act = lambda time: screen.push(PUSHES[key], azimuth) if abs(time - 3.0) < 0.01 else None
    live(quadrotor, quadrotor_solution, screen)
    still = ls.simulate(quadrotor.plant(), quadrotor_solution).frames[0][1:]
    moved = np.array(screen.shown)[:, :3] - still[:, :3]
    right, away, up = PUSHES[key]  # a camera that looks along x has y to its left
    velocity = 30 * (moved[90] - moved[89])
    np.testing.assert_array_equal(moved[:90], 0)
    # A force that is constant over a period takes the robot half as far as its last velocity would; drag is 1 % of it.
    assert velocity @ [away, -right, up] == pytest.approx(0.15, rel=0.01)
    assert 0.05 < max(screen.errors) < 0.4
    assert screen.errors[-1] < 0.03


def test_a_hand_is_felt_and_overcome(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """Half a newton upwards for half a second, a tenth of the weight."""
    screen = Recorder(150, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    wrenches = np.zeros((screen.model.nbody, 6))
    wrenches[screen.robot, 2] = 0.5
    screen.act = lambda time: screen.drag(wrenches * (2.5 < time < 3.0))
    live(quadrotor, quadrotor_solution, screen)
    assert max(screen.errors[:75]) < 1e-6
    assert 0.1 < max(screen.errors) < 1.0
    assert screen.errors[-1] < 0.05


def test_a_hand_is_only_so_strong(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    screen = Recorder(1, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    screen.drag(np.full((screen.model.nbody, 6), 1e4))
    weight = 0.5 * 9.81
    assert np.linalg.norm(screen.pop_wrench(0.1)[:3]) == pytest.approx(2 * weight)
    assert np.linalg.norm(screen.pop_wrench(0.1)[3:]) == pytest.approx(2 * weight * quadrotor.robot.radius)


@pytest.mark.parametrize("size", [0.0, 1e-3, 1e4])
def test_a_hand_on_a_robot_without_a_radius(size: float, rollout: ls.Rollout) -> None:
    """No lever, no torque."""
    screen = Recorder(1, **{**viewer.arguments_for_rollout(rollout, 0), "radius": 0.0})
    screen.drag(np.full((screen.model.nbody, 6), size))
    wrench = screen.pop_wrench(0.1)
    assert (np.linalg.norm(wrench[:3]) > 0) == (size > 0)
    assert not wrench[3:].any()


def test_who_is_lost_starts_again(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """A push to 1 km/s."""
    screen = Recorder(90, push=1000.0, **viewer.arguments_for_plant(quadrotor.plant(), quadrotor_solution))
    screen.act = lambda time: screen.push((1.0, 0.0, 0.0), 0.0) if time < 0.05 else None
    lines = live(quadrotor, quadrotor_solution, screen)
    assert len(lines) > 3
    assert all(re.fullmatch(r"run \d+: lost after \d\.\d s", line) for line in lines)


def test_backspace_starts_again(rollout: ls.Rollout) -> None:
    screen = Recorder(20, **viewer.arguments_for_rollout(rollout, 0))
    screen.act = lambda time: screen.request_restart() if len(screen.shown) == 8 else None
    viewer.play(rollout, screen)
    np.testing.assert_array_equal(screen.shown, [*rollout.frames[0][:8], *rollout.frames[0][:12]])


# Those that share a viewer are the last, for it draws as long as it is there.


@pytest.mark.skipif(sys.platform != "linux", reason="asks the kernel of Linux")
def test_only_loopback_is_listened_to(served: int) -> None:
    assert listening(served) == ["0100007F"]
    assert not refused("127.0.0.1", served)
    assert refused("127.0.0.2", served)
    assert refused("::1", served)


def asked(port: int, path: str, **headers: str | tuple[str, ...]) -> tuple[int, dict[str, str], bytes]:
    """What a plain socket gets: status, headers and the beginning of the body."""
    lines = [
        f"{name}: {one}"
        for name, values in headers.items()
        for one in ([values] if isinstance(values, str) else values)
    ]
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall("\r\n".join([f"GET {path} HTTP/1.1", *lines, "", ""]).encode())
        found = b""
        while b"\r\n\r\n" not in found and (part := connection.recv(65536)):
            found += part
    head, _, body = found.partition(b"\r\n\r\n")
    status, *rest = head.decode().split("\r\n")
    return int(status.split()[1]), dict(line.split(": ", 1) for line in rest), body


def test_only_its_own_pages_are_let_in(served: int) -> None:
    """A page of another site, or of another port of this machine, says so in Origin; no page can leave it out."""
    for name in ("localhost", "127.0.0.1"):
        address = f"ws://127.0.0.1:{served}"
        ours = f"http://{name}:{served}"
        others = ("http://example.org", "null", f"http://{name}:{served + 1}", f"http://{name}", f"https://{name}:{served}",
                  f"{ours}.example.org", f"http://example.org:{served}")  # fmt: skip
        refused = [("drop", None), ("drop", ours), *((path, other) for path in ("ui", "state") for other in others)]
        for path, origin in refused:
            headers = {"Host": f"{name}:{served}", "Upgrade": "websocket", "Connection": "Upgrade",
                       "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}  # fmt: skip
            headers |= {} if origin is None else {"Origin": origin}
            assert asked(served, f"/{path}", **headers)[0] == 403, (name, path, origin)
    with connect(f"{address}/state", origin=Origin(f"http://127.0.0.1:{served}")) as connection:
        assert connection.response is not None
        assert "Access-Control-Allow-Origin" not in connection.response.headers
    with pytest.raises(InvalidStatus, match="403"):  # a server at ::1 may have the other name
        connect(f"{address}/state", origin=Origin(f"http://localhost:{served}"))


def test_a_page_that_sends_junk_takes_no_place(served: int) -> None:
    """Text and bytes that are no message, sixty of each kind of connection: the next pages get the run."""
    rng, ours = np.random.default_rng(36), Origin(f"http://127.0.0.1:{served}")
    for path in ("ui", "state"):
        junk = connect(f"ws://127.0.0.1:{served}/{path}", origin=ours, max_size=None)
        with contextlib.suppress(ConnectionClosed), junk as connection:  # the server may hang up
            for size in rng.integers(1, 300, 30).tolist():
                connection.send(rng.bytes(size))
                connection.send("junk" * size)
    for _ in range(4):
        with connect(f"ws://127.0.0.1:{served}/state", origin=ours, max_size=None) as connection:
            assert ";role=spectator;" in str(connection.recv(timeout=600))


def test_only_by_its_own_name_does_it_answer(served: int) -> None:
    """A site whose name is made to point to this machine would have pages of the same origin."""
    ours, other = f"localhost:{served}", f"example.org:{served}"
    others = ((), "example.org", other, "localhost", f"localhost:{served + 1}", f"0.0.0.0:{served}", (ours, other))
    for path in ("/", "/model", "/model?total_bytes", "/index.html", "/state"):
        for host in others:
            status, _, body = asked(served, path, Host=host)
            assert (status, len(body) < 200) == (403, True), (path, host)


def test_what_it_serves_is_for_its_own_pages(served: int) -> None:
    for path in ("/", "/model", "/model?total_bytes", "/nothing"):
        for name in ("localhost", "127.0.0.1"):
            status, headers, _ = asked(served, path, Host=f"{name}:{served}")
            assert status == (404 if path == "/nothing" else 200)
            assert not [header for header in headers if header.lower().startswith("access-control")]
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
            other = asked(served, path, Host=f"{name}:{served}", Origin="http://example.org")
            assert (other[0], len(other[2]) < 200) == (403, True)


needs_browser = pytest.mark.skipif(not browsing.CHROMIUM, reason="there is no browser: sudo apt-get install chromium")


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which pixels differ by more than a shade."""
    return np.abs(after.astype(int) - before).max(axis=2) > 40


@needs_browser
@pytest.mark.long
def test_a_browser_draws_the_run(served: int, tmp_path: Path) -> None:
    with browsing.browser(f"http://127.0.0.1:{served}/", tmp_path / "profile", size=(250, 200)) as page:
        # A page whose scene has just come may still be laying it out; from some picture on, only what moves changes.
        changes = (changed(*pair) for pair in itertools.pairwise(page.pictures()))
        assert any(20 < of.sum() < 0.2 * of.size for of in changes)  # the robot, its trace and the words, and no more


def test_a_page_gets_the_run_to_the_last_bit(served: int, rollout: ls.Rollout) -> None:
    frames = {frame.tobytes() for frame in rollout.frames[0]}
    seen = set()
    ours = Origin(f"http://127.0.0.1:{served}")
    with connect(f"ws://127.0.0.1:{served}/state", origin=ours, max_size=None) as spectator:
        until = time.monotonic() + 600
        while len(seen) < 10 and time.monotonic() < until:
            payload = spectator.recv(timeout=600)
            spectator.send("state_ack")
            if isinstance(payload, bytes):
                found = [frame for frame in frames if frame in payload]
                assert len(found) == 1
                seen.update(found)
    assert len(seen) >= 10


@needs_browser
@pytest.mark.long
def test_keys_and_the_mouse_reach_the_robot(tmp_path: Path) -> None:
    """In the browser: an arrow key pushes the robot, and Ctrl with the right mouse button drags it."""
    before = """import lqrsim.view.viewer as viewer
push, drag = viewer.Viewer.push, viewer.Viewer.drag
def pushed(self, direction, azimuth):
    push(self, direction, azimuth)
    print("pushed", *direction, flush=True)
def pulled(self, wrenches):
    drag(self, wrenches)
    if self.wrench.any():
        print("pulled", *self.wrench, flush=True)
viewer.Viewer.push, viewer.Viewer.drag = pushed, pulled"""
    with viewing(tmp_path, "quadrotor", "--port", str(PORT + 3), "--speed", "0.3", before=before) as process:
        said(process, "Ctrl-C ends it")
        with browsing.browser(f"http://127.0.0.1:{PORT + 3}/", tmp_path / "profile", size=(500, 400)) as page:
            next(page.pictures())
            said_after(process, "pushed 1.0 0.0 0.0", lambda i: page.press("ArrowRight", 39))
            said_after(process, "pulled", lambda i: page.drag((350, 140), (350, 80)))
